"""What stays of a calibration: all that updating and viewing it need, in memory or in a folder."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import overload

import torch
import trimesh
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.decisions import Transaction
from torchcal.calibrate.result import Calibration, FrameComparison, Status
from torchcal.geometry.projection import Projection
from torchcal.model.job import Job
from torchcal.model.scene import bodies_of


@dataclass(frozen=True, kw_only=True, slots=True)
class FramePlace:
    """Where everything was when a frame was taken."""

    name: str
    T_world_sensor: Float[Tensor, "4 4"]
    pose_covariance: Float[Tensor, "6 6"]
    """Of the twist on the right of ``T_world_sensor``."""
    Ts_world_link: Mapping[str, Float[Tensor, "4 4"]]
    """Of the robot's links that show something."""


class OnDemand(Sequence[FrameComparison]):
    """Comparisons that are read or made when they are asked for.

    Args:
        makers: One for each comparison.
    """

    def __init__(self, makers: Iterable[Callable[[], FrameComparison]]):
        self._makers = tuple(makers)

    def __len__(self) -> int:
        return len(self._makers)

    @overload
    def __getitem__(self, index: int) -> FrameComparison: ...

    @overload
    def __getitem__(self, index: slice) -> "OnDemand": ...

    def __getitem__(self, index: int | slice) -> "FrameComparison | OnDemand":
        if isinstance(index, slice):
            return OnDemand(self._makers[index])
        return self._makers[index]()


@dataclass(frozen=True, kw_only=True, slots=True)
class Result:
    """A calibration as it is kept."""

    status: Status
    message: str
    estimated: bool
    """False: no estimate over all frames stands behind it, and the message says what it is."""
    alpha: float
    """The factor of eq. 5 with which the comparisons were labelled."""
    projection: Projection
    bodies: tuple[str, ...]
    """What ``FrameComparison.body`` counts; links of the robot are ``robot/<link>``."""
    transaction: Transaction
    """The model and its changes."""
    link_meshes: Mapping[str, trimesh.Trimesh]
    """What the robot's links look like, each in its own frame (m)."""
    frames: tuple[FramePlace, ...]
    comparisons: Sequence[FrameComparison]
    """One for each frame; from a folder they are ``OnDemand``."""


def kept(calibration: Calibration) -> Result:
    """What stays of a calibration, with nothing decided."""
    job, estimate = calibration.job, calibration.estimate
    return Result(
        status=estimate.status,
        message=estimate.message,
        estimated=estimate.estimated,
        alpha=job.alpha,
        projection=job.sensor.projection,
        bodies=tuple(body.name for body in bodies_of(job.world, job.robot)),
        transaction=Transaction.undecided(job.file.name, job.world, calibration.update),
        link_meshes={} if job.robot is None else job.robot.link_meshes,
        frames=tuple(_place(calibration, index) for index in range(len(job.frames))),
        comparisons=calibration.comparisons,
    )


def _place(calibration: Calibration, index: int) -> FramePlace:
    estimate = calibration.estimate
    return FramePlace(
        name=calibration.comparisons[index].name,
        T_world_sensor=_plain(estimate.Ts_world_sensor[index]),
        pose_covariance=_plain(estimate.pose_covariances[index]),
        Ts_world_link=_links(calibration, calibration.job, index),
    )


def _links(calibration: Calibration, job: Job, index: int) -> dict[str, Tensor]:
    """Where the links that show something were: at the frame's joints and their offsets."""
    robot, joints = job.robot, job.frames[index].joints
    if robot is None or joints is None:
        return {}
    offsets = calibration.estimate.joint_offsets
    added = [offsets.get(name, 0.0) for name in robot.joint_names]
    true = _plain(joints) + torch.tensor(added, dtype=torch.float64)
    Ts = _plain(calibration.estimate.T_world_base) @ robot.forward_kinematics(true)
    return {link: Ts[robot.link_index(link)] for link in robot.link_meshes}


def _plain(tensor: Tensor) -> Tensor:
    return tensor.detach().cpu().double()
