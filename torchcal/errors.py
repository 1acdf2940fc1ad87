"""Mistakes of the caller: each error says what was found, where, and what is possible."""

from collections.abc import Iterable
from pathlib import Path


class TorchcalError(Exception):
    """Base of every error that torchcal raises on purpose."""


class JobError(TorchcalError):
    """A job, or a file that it names, cannot be read or used.

    Args:
        file: The file in which the mistake is.
        key: The key inside that file, such as ``frame[2].joints.elbow``; empty for the whole file.
        found: What stands there.
        expected: What is possible there.
    """

    def __init__(self, file: Path | str, key: str, found: str, expected: str):
        self.file, self.key, self.found, self.expected = Path(file), key, found, expected
        where = f"{file}: {key}" if key else f"{file}"
        super().__init__(_printable(f"{where}: found {found}; expected {expected}"))


def _printable(text: str) -> str:
    """The text with codes for letters that a terminal would obey."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def choices(names: Iterable[str]) -> str:
    """A sorted list of possible names for an error message."""
    listed = sorted(names)
    return "one of " + ", ".join(listed) if listed else "nothing: there are no names to choose from"
