"""A job as the method uses it: everything read, checked and in metres and radians."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from jaxtyping import Float
from torch import Tensor

from torchcal.errors import TorchcalError
from torchcal.model.range_image import RangeImage
from torchcal.model.robot import Robot
from torchcal.model.sensor import Sensor
from torchcal.model.tensor_mistakes import check_floats
from torchcal.model.world import World

WORLD_LINK = "world"
"""The ``sensor.link`` of a sensor that stands still and watches the robot."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Frame:
    """One range image and where the robot believed to be.

    Raises:
        TorchcalError: If joints or pose are of another shape or kind.
    """

    image: RangeImage
    joints: Float[Tensor, " joint"] | None
    """Joint values (rad, m) in the order of ``Robot.joint_names``; None without a robot."""
    T_world_sensor: Float[Tensor, "4 4"] | None
    """Nominal pose of the sensor; None with a robot."""

    def __post_init__(self):
        if self.joints is not None:
            check_floats("Frame.joints", self.joints, "joint")
        if self.T_world_sensor is not None:
            check_floats("Frame.T_world_sensor", self.T_world_sensor, 4, 4)


@dataclass(frozen=True, kw_only=True, slots=True)
class PosePrior:
    """What may be wrong with a pose: standard deviations of a twist on its right.

    Raises:
        TorchcalError: If there are not six of them.
    """

    sigma: Float[Tensor, " 6"]
    """(m, m, m, rad, rad, rad); 0 holds that axis."""

    def __post_init__(self):
        check_floats("PosePrior.sigma", self.sigma, 6)


@dataclass(frozen=True, kw_only=True, slots=True)
class RangePrior:
    """What may be wrong with the sensor's range: z_measured = offset + (1 + scale) z."""

    offset_sigma: float
    """m"""
    scale_sigma: float


@dataclass(frozen=True, kw_only=True, slots=True)
class Job:
    """A recording and everything that is believed about it.

    Raises:
        TorchcalError: If a pose is no 4x4 matrix, or a frame does not fit the sensor or the robot.
    """

    file: Path
    world: World | None
    robot: Robot | None
    sensor: Sensor
    link: str | None
    """The link that carries the sensor, ``WORLD_LINK`` if it stands still; None without a robot."""
    T_world_base: Float[Tensor, "4 4"]
    """Nominal; identity without a robot."""
    T_link_sensor: Float[Tensor, "4 4"]
    """Nominal mount; identity without a robot."""
    frames: tuple[Frame, ...]
    base: PosePrior | None
    """``unknown.base``; without a robot, one correction shared by the poses of all frames."""
    mount: PosePrior | None
    """``unknown.mount``"""
    joints: Mapping[str, float] = field(default_factory=dict)
    """``unknown.joints``: sigma (rad, m) of the zero position of joints; 0 holds one."""
    objects: Mapping[str, PosePrior] = field(default_factory=dict)
    """``unknown.object``: sigmas about the centre of the object's bounding box."""
    range: RangePrior | None = None
    """``unknown.range``"""
    frame_poses: PosePrior | None = None
    """``unknown.frames``: every frame's pose has an error of its own; None with a robot."""
    initial: Literal["nominal", "anywhere"] = "nominal"
    """Where to start. "anywhere": ``base`` and the nominal pose of base or sensor say nothing."""
    alpha: float = 3.0
    """The factor of eq. 1 and eq. 5."""

    def __post_init__(self):
        check_floats("Job.T_world_base", self.T_world_base, 4, 4)
        check_floats("Job.T_link_sensor", self.T_link_sensor, 4, 4)
        hole = self.sensor.projection
        for k, frame in enumerate(self.frames):
            where = f"Job.frames[{k}]"
            check_floats(f"{where}.image.range", frame.image.range, hole.height, hole.width)
            if self.robot is not None:
                check_floats(f"{where}.joints", frame.joints, len(self.robot.joint_names))


def check_frames(job: Job) -> None:
    """Finds frames without which nothing can be compared.

    Raises:
        TorchcalError: If there are none, or one has no nominal pose where no robot carries it.
    """
    if not job.frames:
        raise TorchcalError(f"{job.file}: found no frames; expected at least one")
    for k, frame in enumerate(job.frames):
        if job.robot is None and frame.T_world_sensor is None:
            words = "found neither a robot nor a T_world_sensor; expected one of them"
            raise TorchcalError(f"Job.frames[{k}]: {words}")
