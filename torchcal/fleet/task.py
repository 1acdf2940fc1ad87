"""A job to be done, what is kept of it, and how an attempt at it ended."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Literal

from torchcal.errors import TorchcalError


@dataclass(frozen=True, kw_only=True, slots=True)
class Task:
    """One job, with everything that a worker must know."""

    name: str
    """Unique; also the place of the result below the output folder."""
    job: Path
    """The job file."""
    folder: Path
    """Where the result goes."""
    fingerprint: str
    """Of the job file and what it names: see ``ledger.fingerprint``."""
    seed: int = 0
    device: Literal["cpu", "cuda"] | None = None
    attempt: int = 1
    """Counts from 1."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Correction:
    """What was found of one parameter: the difference to what the job file believed."""

    value: float
    sigma: float
    """One standard deviation."""
    unit: str
    """``m``, ``rad`` or ``1``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Record:
    """What the table and the page need of a finished job; kept beside its result."""

    fingerprint: str
    status: str
    """``converged`` or another status of ``result.json``."""
    usable: bool
    message: str
    attempts: int
    seconds: float
    frames: int
    agreement: float
    """Share of the compared pixels in which the model agrees, all frames together."""
    robot: str | None
    """The name in the URDF; None without a robot."""
    recorded: str
    """When the youngest image was written: ISO 8601, UTC."""
    corrections: Mapping[str, Correction]
    """By the names of ``result.json``."""


class End(StrEnum):
    """How an attempt ended."""

    DONE = "done"
    UNREADABLE = "unreadable"
    """A mistake of the caller, which another attempt would meet again."""
    ERROR = "error"
    KILLED = "killed"
    """The worker ended before it answered."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Ended:
    """One attempt at a task."""

    task: Task
    end: End
    record: Record | None = None
    """What was done; None unless it was."""
    message: str = ""
    """One sentence for a person where nothing was done."""


Work = Callable[[Task], Record]
"""Does a task: a function of a module, so that other processes can find it by its name."""


def attempt(work: Work, task: Task) -> Ended:
    """Does a task once; whatever goes wrong is an answer and not an exception."""
    try:
        return Ended(task=task, end=End.DONE, record=work(task))
    except TorchcalError as error:
        return Ended(task=task, end=End.UNREADABLE, message=_one_line(error))
    except Exception as error:
        words = f"{type(error).__name__}: {_one_line(error)}"
        return Ended(task=task, end=End.ERROR, message=words)


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
