"""Jobs without images: the demo's arm and the rover in the demo's cell, with parts unknown."""

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from torchcal.demo import cell
from torchcal.demo.recording import JOINTS, LINK, POSTURES, SENSOR, nominal_T_world_base
from torchcal.demo.robots import robot_folder
from torchcal.errors import TorchcalError, choices
from torchcal.geometry import se3
from torchcal.model.job import Frame, Job, PosePrior, RangePrior
from torchcal.model.range_image import RangeImage
from torchcal.model.read_sensor import preset_sensor
from torchcal.model.robot import Robot, load_robot
from torchcal.model.sensor import Drift, Noise, Sensor
from torchcal.model.world import World, WorldObject

OFFSET_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow")
MOVED_OBJECTS = ("workbench", "cabinet")
NO_DRIFT = Drift(sigma=0.0, pixels=1.0)
MORE_POSTURES = 4
"""Of the arm, each beside one of the demo's."""
CLEARANCE = 0.05
"""m"""
MAST_POSITIONS = 20
ROVER_AT = (-1.3, 0.9, 0.4)
"""m, m, rad: where the rover stands in the cell and how far it is turned."""
READS = {"range.offset": 0.005, "range.scale": 0.01}
"""m, and a share: how much too far a wrong sensor reads."""


def job_of(what: str, side: int) -> Job:
    """One of the settings of ``scripts/calibration_experiment.py``, its images still blank.

    Args:
        what: Which one.
        side: Pixels along a side of the arm's images; the rover's presets have their own.

    Raises:
        TorchcalError: If there is no such setting.
    """
    degree = math.radians(1.0)
    jobs = {
        "joints": lambda: replace(arm_job(side), joints=dict.fromkeys(OFFSET_JOINTS, degree)),
        "everything": lambda: replace(
            arm_job(side, more=MORE_POSTURES),
            base=prior(0.03, 2.0),
            joints=dict.fromkeys(JOINTS, degree),
            mount=prior(0.01, 1.0),
            T_link_sensor=_before_housing(),
        ),
        "objects": lambda: replace(arm_job(side), objects=dict.fromkeys(MOVED_OBJECTS, MOVED)),
        "sharp-objects": lambda: replace(
            _sharp(arm_job(side)), objects=dict.fromkeys(MOVED_OBJECTS, MOVED)
        ),
        "range": lambda: replace(
            arm_job(side),
            base=prior(0.05, 2.0),
            range=RangePrior(offset_sigma=0.01, scale_sigma=0.01),
        ),
        "rover-laser": lambda: rover_job("laser-scanner"),
        "rover-sonar": lambda: rover_job("ultrasonic-array"),
    }
    if what not in jobs:
        raise TorchcalError(f"found {what!r}; expected {choices(jobs)}")
    return jobs[what]()


def not_drawn(what: str) -> dict[str, float]:
    """The parameters that have the same true value in all trials of one of the settings."""
    return READS if what == "range" else {}


def prior(position: float, degrees: float) -> PosePrior:
    """The same sigma (m, degrees) on all axes."""
    sigmas = [position] * 3 + [math.radians(degrees)] * 3
    return PosePrior(sigma=torch.tensor(sigmas, dtype=torch.float64))


MOVED = prior(0.05, 5.0)


def arm_job(side: int, more: int = 0) -> Job:
    """The demo's arm in its cell with nothing unknown, and ``more`` postures beside the demo's."""
    robot = load_robot(robot_folder("arm") / "arm.urdf")
    wide = SENSOR.projection.resized(SENSOR.projection.width // side)
    postures = [*POSTURES, *(_beside(POSTURES[k], k) for k in range(more))]
    return _job(
        robot,
        LINK,
        replace(SENSOR, projection=wide),
        nominal_T_world_base(),
        [torch.tensor(posture, dtype=torch.float64) for posture in postures],
    )


def rover_job(preset: str) -> Job:
    """The rover in the cell, its base unknown, with a preset on its mast in 20 positions."""
    robot = load_robot(robot_folder("rover") / "rover.urdf")
    x, y, turn = ROVER_AT
    T_world_base = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, turn], dtype=torch.float64))
    T_world_base[:2, 3] = torch.tensor([x, y], dtype=torch.float64)
    postures = []
    for k in range(MAST_POSITIONS):
        values = dict.fromkeys(robot.joint_names, 0.0)
        values["mast_lift"] = 0.3 * (k % 3) / 2
        values["mast_pan"] = 2.0 * math.pi * k / MAST_POSITIONS
        values["mast_tilt"] = (0.1, 0.35, 0.6, -0.2)[k % 4]
        postures.append(torch.tensor(list(values.values()), dtype=torch.float64))
    sensor = preset_sensor(preset)
    sensor = replace(sensor, noise=replace(sensor.noise, drift=NO_DRIFT))
    job = _job(robot, "lidar", sensor, T_world_base, postures)
    return replace(job, base=prior(0.05, 2.0))


def _before_housing() -> Tensor:
    """Farther before the camera's own housing than a wrong mount may put the sensor into it."""
    T = torch.eye(4, dtype=torch.float64)
    T[2, 3] = CLEARANCE
    return T


def _beside(posture: tuple[float, ...], index: int) -> tuple[float, ...]:
    """Another posture that looks at the same part of the cell."""
    turns = (0.18, -0.15, 0.2, -0.25, 0.3, 0.4)
    return tuple(
        value + (-turn if index % 2 else turn) for value, turn in zip(posture, turns, strict=True)
    )


def _sharp(job: Job) -> Job:
    noise = Noise(a=0.005, drift=NO_DRIFT)
    return replace(job, sensor=replace(job.sensor, noise=noise, beam=1))


def _job(
    robot: Robot, link: str, sensor: Sensor, T_world_base: Tensor, postures: list[Tensor]
) -> Job:
    eye = torch.eye(4, dtype=torch.float64)
    objects = (
        WorldObject(
            name=item.name, mesh=item.mesh, T_world_object=torch.from_numpy(item.T_world_object)
        )
        for item in cell.modelled_objects()
    )
    frames = (
        Frame(
            image=RangeImage.blank(f"{k:04d}", f"{k:04d}.png", sensor),
            joints=joints,
            T_world_sensor=None,
        )
        for k, joints in enumerate(postures, start=1)
    )
    return Job(
        file=Path("job.toml"),
        world=World(objects=tuple(objects), complete=True),
        robot=robot,
        sensor=sensor,
        link=link,
        T_world_base=T_world_base,
        T_link_sensor=eye,
        frames=tuple(frames),
        base=None,
        mount=None,
    )
