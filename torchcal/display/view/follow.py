"""The view of a recording that ``torchcal follow`` works on at the same time."""

import json
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from torchcal.calibrate.decisions import Transaction
from torchcal.calibrate.followed import Followed
from torchcal.calibrate.kept_result import OnDemand, Result
from torchcal.calibrate.result import Status, Update
from torchcal.calibrate.tracked import TrackStatus
from torchcal.errors import TorchcalError

WAITING = "Waiting for the first frame of torchcal follow."
SAID = {
    TrackStatus.TRACKING.value: Status.CONVERGED,
    TrackStatus.AMBIGUOUS.value: Status.AMBIGUOUS,
}
"""What a frame's status says of the whole; all else is a failure."""


@dataclass(slots=True)
class FollowSource:
    """The lines that ``torchcal follow`` writes, as they come.

    Args:
        followed: The recording.
        find: Says where ``frames.jsonl`` is now; None while there is none.
    """

    followed: Followed
    find: Callable[[], Path | None]
    read: int = 0
    """Bytes of the file that were looked at."""
    file: int | None = None
    """Which file it was: another one is another run."""
    lines: list[dict[str, Any]] = field(default_factory=list)

    @property
    def can_decide(self) -> bool:
        """Never: following proposes no changes."""
        return False

    def latest(self, shown: Result | None) -> Result:
        """The result with a frame for each whole line.

        Raises:
            TorchcalError: If a line is not one of this version's ``torchcal follow``.
        """
        if not self._read() and shown is not None:
            return shown
        return self._result()

    def decide(self, *, accept: Collection[str], reject: Collection[str]) -> None:
        """Refuses.

        Raises:
            TorchcalError: Always.
        """
        raise TorchcalError("found a recording; expected the folder of a calibration to decide on")

    def _read(self) -> bool:
        """Whether there are new lines."""
        path = self.find()
        if path is None:
            return False
        try:
            with path.open("rb") as file:
                stat = path.stat()
                if stat.st_ino != self.file or stat.st_size < self.read:
                    self.file, self.read, self.lines = stat.st_ino, 0, []
                file.seek(self.read)
                whole = file.read().rpartition(b"\n")[0]
        except FileNotFoundError:
            return False  # renamed in between; the next look finds it
        if not whole:
            return False
        self.read += len(whole) + 1
        try:
            self.lines += [json.loads(line) for line in whole.splitlines()]
        except ValueError as error:
            raise TorchcalError(f"{path}: found a line that is no JSON ({error})") from error
        return True

    def _result(self) -> Result:
        job = self.followed.job
        try:
            passed = [self.followed.passed(k, line) for k, line in enumerate(self.lines)]
        except (KeyError, TypeError, ValueError) as error:
            found = f"a line without {error}"
            raise TorchcalError(f"found {found}; expected one of this torchcal follow") from error
        status, message = _said(self.lines[-1]) if self.lines else (Status.FAILED, WAITING)
        nothing = Update(verdicts={}, added=())
        return Result(
            status=status,
            message=message,
            estimated=False,
            alpha=job.alpha,
            projection=job.sensor.projection,
            bodies=tuple(body.name for body in self.followed.scene.bodies),
            transaction=Transaction.undecided(job.file.name, job.world, nothing),
            link_meshes={} if job.robot is None else job.robot.link_meshes,
            frames=tuple(self.followed.place(each) for each in passed),
            comparisons=OnDemand(partial(self.followed.comparison, each) for each in passed),
        )


def _said(line: dict[str, Any]) -> tuple[Status, str]:
    """What a line says of its frame."""
    alarm = "ALARM: " if line["alarm"] else ""
    status = Status.FAILED if alarm else SAID.get(line["status"], Status.FAILED)
    return status, f"{alarm}{line['status']}, frame {line['name']}: {line['message']}"
