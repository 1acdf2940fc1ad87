"""The demo's job: an arm in a cell that is not what the model says, recorded in six postures."""

import math
import shutil
from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from numpy import ndarray
from PIL import Image
from torch import Tensor

from torchcal.demo import cell, raycast
from torchcal.demo.robots import robot_folder
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.robot import Robot, load_robot
from torchcal.model.sensor import Drift, Noise, Sensor
from torchcal.model.write_job import write_job

LINK = "depth_optical_frame"

SIDE = 512
FOCAL = SIDE / 2 / math.tan(math.radians(25.0))
"""Pixels; 50 degrees of view (paper, 4.2)."""

SENSOR = Sensor(
    projection=Pinhole(
        width=SIDE, height=SIDE, fx=FOCAL, fy=FOCAL, cx=(SIDE - 1) / 2, cy=(SIDE - 1) / 2
    ),
    noise=Noise(a=0.05, drift=Drift(sigma=0.0, pixels=1.0)),
    near=0.3,
    far=10.0,
    beam=21,
    depth_unit=0.0005,
)
"""The sensor of the paper's 4.2. A depth unit is a hundredth of sigma: rounding does no harm."""

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")

POSTURES = (
    (-0.08, -0.42, 1.65, -0.09, 0.69, -2.91),  # machine
    (-0.82, -0.49, 2.04, 0.20, 0.43, 2.72),  # conveyor
    (-2.09, 0.48, -1.56, -0.12, -0.78, 0.29),  # workbench
    (2.15, -0.34, 1.86, 0.12, 0.41, 2.87),  # door
    (2.83, -0.41, 1.64, -0.15, 0.70, -2.73),  # cabinet and tank
    (0.56, 0.40, -1.33, 0.10, -1.05, -0.26),  # crates
)
"""Joint values (rad): the camera looks all the way round the cell, a little down, never level."""

POSITION_SIGMA, ROTATION_SIGMA_DEG = 0.06, 3.0
"""The job's prior of the base (m, degrees)."""

_HEADING = (
    "A robot cell. The arm stands some centimetres and degrees off its drawing; one object of the",
    "model is gone and one is there that the model does not know.",
)


@dataclass(frozen=True, kw_only=True, slots=True)
class DemoTruth:
    """The job that was made, and what a calibration should find."""

    job: Path
    """The job file."""
    T_world_base: Float[Tensor, "4 4"]
    """Where the robot really stands."""
    removed: tuple[str, ...]
    """Objects of the model that are not there."""
    added: dict[str, tuple[cell.Triple, cell.Triple]]
    """Objects that are not in the model: centre and extent (m) of their boxes in world axes."""
    objects: tuple[str, ...]
    """All objects of the model."""


def make_demo(
    folder: Path, *, seed: int = 0, progress: Callable[[str, float], None] | None = None
) -> DemoTruth:
    """Writes a job with its arm, its model of the cell and its recording into a folder.

    Args:
        folder: Is made where it is missing; files of the same names are replaced.
        seed: Chooses the error of the base's pose, and the noise.
        progress: Called with what is being done and how much of it is (0 to 1).

    Raises:
        TorchcalError: If Embree is not installed.
    """
    rng = np.random.default_rng(seed)
    report = progress or _silent
    report("building the cell", 0.0)
    shutil.copytree(robot_folder("arm"), folder / "arm", dirs_exist_ok=True)
    cell.as_scene(cell.modelled_objects()).export(folder / "cell.glb")
    write_job(folder / "job.toml", _job_tables(), heading=_HEADING)
    T_world_base = nominal_T_world_base() @ se3.exp(torch.from_numpy(base_error(rng)))
    robot = load_robot(folder / "arm" / "arm.urdf")
    for index, posture in enumerate(POSTURES):
        report(f"recording frame {index + 1} of {len(POSTURES)}", index / len(POSTURES))
        image = _record(robot, T_world_base, posture, rng)
        _write_depth(folder / _file(index), image)
    report("recorded", 1.0)
    return DemoTruth(
        job=folder / "job.toml",
        T_world_base=T_world_base,
        removed=(cell.REMOVED,),
        added={cell.ADDED: _added_box()},
        objects=tuple(each.name for each in cell.modelled_objects()),
    )


def nominal_T_world_base() -> Float[Tensor, "4 4"]:
    """Where the job says that the robot stands."""
    return se3.from_xyz_rpy(
        torch.tensor([0.0, 0.0, cell.PEDESTAL_HEIGHT], dtype=torch.float64),
        torch.zeros(3, dtype=torch.float64),
    )


def base_error(rng: np.random.Generator) -> Float[ndarray, " 6"]:
    """How far the robot stands off: a twist of 30 to 60 mm and 2 to 3 degrees, in any direction."""
    along, about = (_direction(rng) for _ in range(2))
    return np.concatenate(
        [rng.uniform(0.03, 0.06) * along, np.radians(rng.uniform(2.0, 3.0)) * about]
    )


def view_of(
    objects: tuple[cell.CellObject, ...],
    robot: Robot,
    T_world_base: Float[Tensor, "4 4"],
    posture: tuple[float, ...],
) -> raycast.View:
    """The cell and the robot's own links as the sensor sees them in a posture (rad)."""
    Ts_base_link = robot.forward_kinematics(torch.tensor(posture, dtype=torch.float64))
    Ts_world_link = (T_world_base @ Ts_base_link).numpy()
    poses = dict(zip(robot.link_names, Ts_world_link, strict=True))
    links = [_moved(mesh, poses[name]) for name, mesh in robot.link_meshes.items()]
    return raycast.view([*(each.in_world() for each in objects), *links], poses[LINK])


def _record(
    robot: Robot,
    T_world_base: Float[Tensor, "4 4"],
    posture: tuple[float, ...],
    rng: np.random.Generator,
) -> Float[ndarray, "h w"]:
    view = view_of(cell.real_objects(), robot, T_world_base, posture)
    predicted = raycast.predict(view, SENSOR.projection, SENSOR.beam)
    return raycast.measure(predicted, SENSOR, rng)


def _direction(rng: np.random.Generator) -> Float[ndarray, " 3"]:
    vector = rng.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _moved(mesh: trimesh.Trimesh, T_world_link: Float[ndarray, "4 4"]) -> trimesh.Trimesh:
    return mesh.copy().apply_transform(T_world_link)


def _added_box() -> tuple[cell.Triple, cell.Triple]:
    added = next(each for each in cell.real_objects() if each.name == cell.ADDED)
    low, high = added.in_world().bounds
    return tuple(((low + high) / 2).tolist()), tuple((high - low).tolist())


def _write_depth(file: Path, image: Float[ndarray, "h w"]) -> None:
    """16 bits; 0 where nothing was measured."""
    units = np.nan_to_num(np.round(image / SENSOR.depth_unit), nan=0.0)
    Image.fromarray(units.astype(np.uint16)).save(file)


def _file(index: int) -> str:
    return f"{index + 1:04d}.png"


def _silent(what: str, share: float) -> None:
    """Tells nobody."""


def _job_tables() -> dict[str, Any]:
    projection = SENSOR.projection
    assert isinstance(projection, Pinhole)
    return {
        "world": {"model": "cell.glb", "complete": True},
        "robot": {"urdf": "arm/arm.urdf", "base": {"xyz": [0.0, 0.0, cell.PEDESTAL_HEIGHT]}},
        "sensor": {
            "link": LINK,
            "model": "pinhole",
            **{each.name: getattr(projection, each.name) for each in fields(projection)},
            "depth_unit": SENSOR.depth_unit,
            "range": [SENSOR.near, SENSOR.far],
            "sigma": SENSOR.noise.a,
            "drift": 0,
            "beam": SENSOR.beam,
        },
        "frame": [
            {"depth": _file(index), "joints": dict(zip(JOINTS, posture, strict=True))}
            for index, posture in enumerate(POSTURES)
        ],
        "unknown": {
            "base": {"position_sigma": POSITION_SIGMA, "rotation_sigma_deg": ROTATION_SIGMA_DEG}
        },
    }
