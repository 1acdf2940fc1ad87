"""Where the view's result comes from: a folder that is written on, or memory."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

from torchcal.calibrate.kept_result import Result
from torchcal.calibrate.result_folder import NEW_WORLD, read_result, read_transaction
from torchcal.display.decided import decide
from torchcal.errors import TorchcalError

Stamp = tuple[int, int]
"""When a file was written, and which one it is."""


@runtime_checkable
class Source(Protocol):
    """What the view shows and writes to."""

    @property
    def can_decide(self) -> bool:
        """Whether proposals may be accepted and rejected."""
        ...

    def latest(self, shown: Result | None) -> Result:
        """The result as it is now; ``shown`` itself where nothing has changed since."""
        ...

    def decide(self, *, accept: Collection[str], reject: Collection[str]) -> None:
        """Accepts and rejects proposals; ``latest`` shows it.

        Raises:
            TorchcalError: If that cannot be done.
        """
        ...


@dataclass(slots=True)
class FolderSource:
    """The folder of a calibration; decisions are those of ``torchcal update``, whoever made them.

    Args:
        folder: What ``torchcal calibrate`` wrote.
    """

    folder: Path
    result: Stamp | None = None
    """Of the ``result.json`` that is shown."""
    world: Stamp | None = None
    """Of the ``world.glb`` that is shown."""

    @property
    def can_decide(self) -> bool:
        """Always: they are written into the folder."""
        return True

    def latest(self, shown: Result | None) -> Result:
        """Reads the folder, later what was decided since.

        Raises:
            TorchcalError: As ``read_result``; or if another result has taken the folder's place.
        """
        result, world = _stamp(self.folder / "result.json"), _stamp(self.folder / NEW_WORLD)
        if shown is None:
            read = read_result(self.folder)
        elif result != self.result:
            raise TorchcalError(f"{self.folder}: found another result; start torchcal view anew")
        elif world == self.world:
            return shown
        else:
            read = replace(shown, transaction=read_transaction(self.folder))
        self.result, self.world = result, world
        return read

    def decide(self, *, accept: Collection[str], reject: Collection[str]) -> None:
        """As ``torchcal.decide``.

        Raises:
            TorchcalError: If the folder cannot be read or written.
        """
        try:
            decide(self.folder, accept=accept, reject=reject)
        except OSError as error:
            raise TorchcalError(
                f"{self.folder}: found {error}; expected a folder to write"
            ) from error


@dataclass(frozen=True, slots=True)
class KeptSource:
    """A result in memory, to look at."""

    result: Result

    @property
    def can_decide(self) -> bool:
        """Never: there is no folder to write into."""
        return False

    def latest(self, shown: Result | None) -> Result:
        """The result."""
        return self.result

    def decide(self, *, accept: Collection[str], reject: Collection[str]) -> None:
        """Refuses.

        Raises:
            TorchcalError: Always.
        """
        raise TorchcalError("found a job; expected the folder of a calibration to decide about it")


def _stamp(file: Path) -> Stamp | None:
    try:
        stat = file.stat()
    except OSError:
        return None
    return stat.st_mtime_ns, stat.st_ino
