"""What a program's answers to a benchmark's jobs are worth."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.demo.range_trials import errors
from torchcal.demo.swept_jobs import Truth
from torchcal.errors import JobError
from torchcal.geometry import se3

FOUND = 0.01
"""Largest error (m and rad) of a pose that counts as found."""
SURE = 5.0
"""Of a program's own sigmas, on the worst axis: an answer farther off was sure and wrong."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Answer:
    """What one program said of one job."""

    status: str
    """As ``result.json`` has it."""
    Ts_world_sensor: Float[Tensor, "frame 4 4"]
    sigma: Float[Tensor, "frame 6"] | None
    """m and rad, of a twist on the right of each pose; None where the program does not say."""

    @property
    def usable(self) -> bool:
        """It called the answer good."""
        return self.status == "converged"

    @property
    def doubtful(self) -> bool:
        """It said that the images cannot tell."""
        return self.status in ("ambiguous", "unobservable")


@dataclass(frozen=True, kw_only=True, slots=True)
class Judged:
    """One answer beside the truth."""

    position: float
    """m, in the worst frame; infinite without an answer."""
    rotation: float
    """rad"""
    usable: bool
    found: bool
    """Usable and right, or where the images cannot tell an answer that says so."""
    deceived: bool
    """Usable and wrong, by the program's own sigmas where it states any."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Score:
    """All answers of one program at one level of one factor."""

    jobs: int
    found: int
    deceived: int
    position: float
    """m: the median over usable answers; NaN without one."""
    rotation: float
    """rad"""


def read_answer(file: Path) -> Answer | None:
    """The answer in a ``result.json``; None where there is no such file or no pose in it.

    Raises:
        JobError: If the file is no ``result.json``.
    """
    if not file.is_file():
        return None
    try:
        data = json.loads(file.read_text(encoding="utf-8"))
        frames = data["frames"]
        poses = torch.tensor([frame["T_world_sensor"] for frame in frames], dtype=torch.float64)
        return Answer(
            status=data["status"],
            Ts_world_sensor=poses.reshape(-1, 4, 4),
            sigma=_sigmas(frames),
        )
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        expected = 'JSON with "status" and "frames", each frame with "T_world_sensor"'
        raise JobError(file, "", f"{type(error).__name__}: {error}", expected) from error


def judged(answer: Answer | None, truth: Truth) -> Judged:
    """One answer beside the truth, modulo the motions that no image can tell."""
    if answer is None or answer.Ts_world_sensor.shape != truth.Ts_world_sensor.shape:
        return Judged(
            position=math.inf,
            rotation=math.inf,
            usable=False,
            found=False,
            deceived=False,
        )
    true = truth.symmetries[:, None] @ truth.Ts_world_sensor
    each = torch.stack(errors(answer.Ts_world_sensor.expand_as(true), true)).amax(-1)
    best = int(each.sum(0).argmin())
    position, rotation = each[:, best].tolist()
    near = max(position, rotation) <= FOUND
    return Judged(
        position=position,
        rotation=rotation,
        usable=answer.usable,
        found=answer.usable and near if truth.observable else answer.doubtful,
        deceived=answer.usable and not _is_covered(answer, true[best], near),
    )


def score(answers: Sequence[Judged]) -> Score:
    """Sums up the answers at one level."""
    usable = [each for each in answers if each.usable]
    return Score(
        jobs=len(answers),
        found=sum(each.found for each in answers),
        deceived=sum(each.deceived for each in answers),
        position=median(each.position for each in usable) if usable else math.nan,
        rotation=median(each.rotation for each in usable) if usable else math.nan,
    )


def truth_data(truth: Truth) -> dict[str, Any]:
    """A truth as plain data."""
    return {
        "factor": truth.factor,
        "level": truth.level,
        "Ts_world_sensor": truth.Ts_world_sensor.tolist(),
        "symmetries": truth.symmetries.tolist(),
        "observable": truth.observable,
    }


def read_truth(file: Path, data: Mapping[str, Any]) -> Truth:
    """The truth that ``truth_data`` made plain.

    Raises:
        JobError: If a key is missing.
    """
    try:
        return Truth(
            factor=data["factor"],
            level=data["level"],
            Ts_world_sensor=torch.tensor(data["Ts_world_sensor"], dtype=torch.float64),
            symmetries=torch.tensor(data["symmetries"], dtype=torch.float64),
            observable=data["observable"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise JobError(file, "", f"{error}", "the truth of a benchmark as it was made") from error


def _sigmas(frames: Sequence[Mapping[str, Any]]) -> Tensor | None:
    if not frames or any("position_sigma_m" not in frame for frame in frames):
        return None
    rows = [[*frame["position_sigma_m"], *frame["rotation_sigma_rad"]] for frame in frames]
    return torch.tensor(rows, dtype=torch.float64)


def _is_covered(answer: Answer, true: Tensor, near: bool) -> bool:
    """Whether the truth is where the program says that it may be."""
    if answer.sigma is None:
        return near
    offset = se3.log(se3.inverse(answer.Ts_world_sensor) @ true)
    return bool((offset.abs() <= SURE * answer.sigma).all())
