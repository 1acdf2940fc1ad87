"""Trajectories of a camera in the files of Open3D and of the TUM benchmark."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.errors import JobError
from torchcal.geometry import se3
from torchcal.model.job_mistakes import shown
from torchcal.model.regular_file import refuse_irregular

_LOOSE = 1e-3
"""How far from a rotation a matrix may be: files hold a few digits."""
_TUM_COLUMNS = 8
_LOG_LINES = 5
"""Of one pose in a .log file: ids, and four rows."""
_LOOSE_LENGTH = 0.01
"""How far from 1 the length of a quaternion may be: files hold a few digits."""
_LOG_FORM = "for each pose a line of three whole numbers and four rows of four, as Open3D writes it"
_TUM_FORM = "time, x, y, z, qx, qy, qz, qw in each row, as the TUM benchmark has it"

Row = tuple[int, list[str]]
"""The number of a line, and its words."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Trajectory:
    """Poses of a camera in optical axes."""

    Ts_world_sensor: Float[Tensor, "pose 4 4"]
    times: Float[Tensor, " pose"] | None
    """s; None: one for each image, in their order."""


def read_trajectory(file: Path) -> Trajectory | None:
    """The poses of a ``.log``, ``.json`` or ``.txt`` file; None for files that hold none.

    Raises:
        JobError: If the file begins like a trajectory and does not go on like one, or if a pose
            is no rigid motion.
    """
    refuse_irregular(file)
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None
    if file.suffix == ".json":
        found = _json_poses(file, text)
    else:
        lines = [(k, line.split()) for k, line in enumerate(text.splitlines(), 1)]
        rows = [(k, words) for k, words in lines if words and not words[0].startswith("#")]
        found = _log_poses(file, rows) or _tum_poses(file, rows)
    if found is not None:
        _check_rigid(file, found.Ts_world_sensor)
    return found


def _log_poses(file: Path, rows: list[Row]) -> Trajectory | None:
    """Open3D: a line of three whole numbers, then four rows of T_world_camera."""
    if [len(words) for _, words in rows[:2]] != [3, 4] or not _are_whole(rows[0][1]):
        return None
    for k, (line, words) in enumerate(rows):
        if len(words) != (4 if k % _LOG_LINES else 3):
            raise _broken(file, line, f"{len(words)} words", _LOG_FORM)
    if len(rows) % _LOG_LINES:
        raise _broken(file, rows[-1][0], "the end within a pose", _LOG_FORM)
    matrices = [row for k, row in enumerate(rows) if k % _LOG_LINES]
    return Trajectory(
        Ts_world_sensor=_numbers(file, matrices, _LOG_FORM).reshape(-1, 4, 4), times=None
    )


def _tum_poses(file: Path, rows: list[Row]) -> Trajectory | None:
    """TUM: time, position and quaternion (xyzw) in each row."""
    if not rows or len(rows[0][1]) != _TUM_COLUMNS or not _is_number(rows[0][1][0]):
        return None
    for line, words in rows:
        if len(words) != _TUM_COLUMNS:
            raise _broken(file, line, f"{len(words)} words", _TUM_FORM)
    time, xyz, quaternion = _numbers(file, rows, _TUM_FORM).split((1, 3, 4), -1)
    length = quaternion.norm(dim=-1)
    for k in ((length - 1.0).abs() > _LOOSE_LENGTH).nonzero().flatten().tolist():
        found = f"a quaternion of length {float(length[k]):.3g}"
        raise _broken(file, rows[k][0], found, f"one of length 1: {_TUM_FORM}")
    Ts = se3.from_quaternion(xyz, quaternion.roll(1, -1))
    return Trajectory(Ts_world_sensor=Ts, times=time[:, 0])


def _json_poses(file: Path, text: str) -> Trajectory | None:
    """Open3D: ``parameters``, each with an ``extrinsic`` T_camera_world, column by column."""
    content = read_json(text)
    parameters = content.get("parameters") if isinstance(content, dict) else None
    if not isinstance(parameters, list) or not parameters:
        return None
    flat = [each.get("extrinsic") if isinstance(each, dict) else None for each in parameters]
    if flat[0] is None:
        return None
    rows = [_column_by_column(file, k, matrix) for k, matrix in enumerate(flat)]
    Ts = torch.tensor(rows, dtype=torch.float64).reshape(-1, 4, 4).mT
    return Trajectory(Ts_world_sensor=torch.linalg.inv_ex(Ts).inverse, times=None)


def _column_by_column(file: Path, index: int, matrix: object) -> list[float]:
    if not isinstance(matrix, list) or len(matrix) != 16 or not all(map(_is_number, matrix)):
        expected = "a list of 16 finite numbers"
        raise JobError(file, f"parameters[{index}].extrinsic", shown(matrix), expected)
    return [float(number) for number in matrix]


def read_json(text: str) -> Any:
    """The content of a JSON file; None for what is none."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _numbers(file: Path, rows: list[Row], form: str) -> Float[Tensor, "row column"]:
    for line, words in rows:
        wrong = next((word for word in words if not _is_number(word)), None)
        if wrong is not None:
            raise _broken(file, line, shown(wrong), f"finite numbers: {form}")
    return torch.tensor([[float(word) for word in words] for _, words in rows], dtype=torch.float64)


def _is_number(word: object) -> bool:
    try:
        return not isinstance(word, bool) and math.isfinite(float(word))  # pyright: ignore
    except (TypeError, ValueError, OverflowError):
        return False


def _are_whole(words: list[str]) -> bool:
    return all(word.lstrip("-").isdecimal() for word in words)


def _broken(file: Path, line: int, found: str, expected: str) -> JobError:
    return JobError(file, f"line {line}", found, expected)


def _check_rigid(file: Path, Ts: Float[Tensor, "pose 4 4"]) -> None:
    R, last = Ts[:, :3, :3], torch.eye(4, dtype=Ts.dtype)[3]
    eye = torch.eye(3, dtype=R.dtype)
    rigid = ((R @ R.mT - eye).abs().amax((1, 2)) < _LOOSE) & (torch.linalg.det(R) > 0.0)
    rigid &= Ts.isfinite().all(2).all(1) & ((Ts[:, 3] - last).abs().amax(1) < _LOOSE)
    if not rigid.all():
        wrong = int((~rigid).nonzero()[0])
        expected = "a rotation and a translation in metres"
        raise JobError(file, f"pose[{wrong + 1}]", "a matrix that is no rigid motion", expected)
