"""Files that can be read to their end: a pipe or a device would keep its reader for ever."""

import stat
from pathlib import Path

from torchcal.errors import JobError

_KINDS = (
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISSOCK, "a socket"),
)


def irregular(path: Path) -> str:
    """What stands at a path if it is no regular file, no folder and not nothing; else empty."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return ""
    named = next((name for is_kind, name in _KINDS if is_kind(mode)), "")
    return named and f"{named}, not a regular file"


def refuse_irregular(file: Path) -> None:
    """Raises for pipes and devices, before they are opened.

    Raises:
        JobError: With what the file is.
    """
    found = irregular(file)
    if found:
        raise JobError(file, "", found, "a regular file")
