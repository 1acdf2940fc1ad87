"""Trajectories of a camera in the files of Open3D and of the TUM benchmark."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.errors import JobError
from torchcal.geometry import se3

_LOOSE = 1e-3
"""How far from a rotation a matrix may be: files hold a few digits."""
_TUM_COLUMNS = 8
_LOG_LINES = 5
"""Of one pose in a .log file: ids, and four rows."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Trajectory:
    """Poses of a camera in optical axes."""

    Ts_world_sensor: Float[Tensor, "pose 4 4"]
    times: Float[Tensor, " pose"] | None
    """s; None: one for each image, in their order."""


def read_trajectory(file: Path) -> Trajectory | None:
    """The poses of a ``.log``, ``.json`` or ``.txt`` file; None for files that hold none.

    Raises:
        JobError: If a matrix is no rigid motion.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return None
    found = _json_poses(text) if file.suffix == ".json" else _log_poses(text) or _tum_poses(text)
    if found is not None:
        _check_rigid(file, found.Ts_world_sensor)
    return found


def _log_poses(text: str) -> Trajectory | None:
    """Open3D: a line of three whole numbers, then four rows of T_world_camera."""
    rows = [line.split() for line in text.splitlines() if line.strip()]
    if not rows or len(rows) % _LOG_LINES or any(len(ids) != 3 for ids in rows[::_LOG_LINES]):
        return None
    numbers = _numbers([word for k, row in enumerate(rows) if k % _LOG_LINES for word in row])
    if numbers is None or len(numbers) != 16 * len(rows) // _LOG_LINES:
        return None
    return Trajectory(Ts_world_sensor=numbers.reshape(-1, 4, 4), times=None)


def _tum_poses(text: str) -> Trajectory | None:
    """TUM: time, position and quaternion (xyzw) in each row."""
    rows = [line.split() for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    if not rows or any(len(row) != _TUM_COLUMNS for row in rows):
        return None
    numbers = _numbers([word for row in rows for word in row])
    if numbers is None:
        return None
    time, xyz, quaternion = numbers.reshape(-1, _TUM_COLUMNS).split((1, 3, 4), -1)
    Ts = se3.from_quaternion(xyz, quaternion.roll(1, -1))
    return Trajectory(Ts_world_sensor=Ts, times=time[:, 0])


def _json_poses(text: str) -> Trajectory | None:
    """Open3D: ``parameters``, each with an ``extrinsic`` T_camera_world, column by column."""
    content = read_json(text)
    parameters = content.get("parameters") if isinstance(content, dict) else None
    if not isinstance(parameters, list) or not parameters:
        return None
    flat = [each.get("extrinsic") if isinstance(each, dict) else None for each in parameters]
    if any(not isinstance(matrix, list) or len(matrix) != 16 for matrix in flat):
        return None
    Ts = torch.tensor(flat, dtype=torch.float64).reshape(-1, 4, 4).mT
    return Trajectory(Ts_world_sensor=torch.linalg.inv_ex(Ts).inverse, times=None)


def read_json(text: str) -> Any:
    """The content of a JSON file; None for what is none."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return None


def _numbers(words: list[str]) -> Tensor | None:
    try:
        return torch.tensor([float(word) for word in words], dtype=torch.float64)
    except ValueError:
        return None


def _check_rigid(file: Path, Ts: Float[Tensor, "pose 4 4"]) -> None:
    R = Ts[:, :3, :3]
    eye = torch.eye(3, dtype=R.dtype)
    rigid = ((R @ R.mT - eye).abs().amax((1, 2)) < _LOOSE) & (torch.linalg.det(R) > 0.0)
    if not rigid.all():
        wrong = int((~rigid).nonzero()[0])
        expected = "a rotation and a translation in metres"
        raise JobError(file, f"pose[{wrong + 1}]", "a matrix that is no rigid motion", expected)
