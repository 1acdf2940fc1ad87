"""The unknown parameter vector q (eq. 3): its named parts, what they move, and their prior.

A state is ``(T_world_base, T_link_sensor)`` as ``(*batch, 2, 4, 4)``. Every step is a twist on the
right of each. Without a robot the base is the first frame's sensor pose and the mount is the
identity, so that T_k = T_1 exp(xi) T_1^-1 T_k falls out of the same product.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.geometry import se3
from torchcal.model.job import WORLD_LINK, Job
from torchcal.model.scene import Scene, body_poses

AXES = ("x", "y", "z", "rx", "ry", "rz")


@dataclass(frozen=True, kw_only=True, slots=True)
class Parameters:
    """Names, prior and kinematics of everything that may be wrong in a job."""

    names: tuple[str, ...]
    prior_sigma: Float[Tensor, " parameter"]
    """m, rad"""
    columns: Float[Tensor, "12 parameter"]
    """Unit columns: which axes of the base's and the mount's twist are free."""
    nominal: Float[Tensor, "2 4 4"]
    standing: bool
    """The sensor stands still in the world: its pose is the mount alone."""
    Ts_base_carrier: Float[Tensor, "frame 4 4"]
    """Pose in the base of what carries the sensor, for each frame."""
    Ts_anchor_body: Float[Tensor, "frame body 4 4"]
    """Pose of each body in the world, or in the base if the base carries it."""
    on_robot: Bool[Tensor, " body"]

    @staticmethod
    def of(job: Job, scene: Scene) -> "Parameters":
        """The parameters that the job declares unknown."""
        names, sigmas, columns = _free_axes(job)
        base = job.T_world_base if job.robot else _frame_pose(job, 0)
        return Parameters(
            names=names,
            prior_sigma=sigmas,
            columns=columns,
            nominal=torch.stack([base, job.T_link_sensor]),
            standing=job.link == WORLD_LINK,
            Ts_base_carrier=_carriers(job),
            Ts_anchor_body=_anchored_bodies(job, scene),
            on_robot=torch.tensor(
                [body.link is not None for body in scene.bodies], device=base.device
            ),
        )

    def retract(
        self, state: Float[Tensor, "*batch 2 4 4"], step: Float[Tensor, "*batch parameter"]
    ) -> Float[Tensor, "*batch 2 4 4"]:
        """Moves base and mount by a step of the parameters: T exp(xi)."""
        twists = (step @ self.columns.mT).unflatten(-1, (2, 6))
        return state @ se3.exp(twists)

    def difference(
        self, state: Float[Tensor, "*#batch 2 4 4"], origin: Float[Tensor, "*#batch 2 4 4"]
    ) -> Float[Tensor, "*batch parameter"]:
        """The parameters that lead from one state to another."""
        twists = se3.log(se3.inverse(origin) @ state).flatten(-2)
        return twists @ self.columns

    def sensor_poses(
        self, state: Float[Tensor, "*batch 2 4 4"]
    ) -> Float[Tensor, "*batch frame 4 4"]:
        """``Ts_world_sensor`` of all frames."""
        base, mount = state[..., None, 0, :, :], state[..., None, 1, :, :]
        if self.standing:
            return mount.expand(*state.shape[:-3], len(self.Ts_base_carrier), 4, 4)
        return base @ self.Ts_base_carrier @ mount

    def bodies_in_sensor(
        self, state: Float[Tensor, "*batch 2 4 4"]
    ) -> Float[Tensor, "*batch frame body 4 4"]:
        """``Ts_sensor_body`` of all frames and bodies."""
        T_sensor_world = se3.inverse(self.sensor_poses(state))[..., :, None, :, :]
        base = state[..., None, None, 0, :, :]
        on_robot = self.on_robot[:, None, None]
        Ts_world_body = torch.where(on_robot, base @ self.Ts_anchor_body, self.Ts_anchor_body)
        return T_sensor_world @ Ts_world_body

    def motion(
        self, state: Float[Tensor, "*batch 2 4 4"]
    ) -> Float[Tensor, "*batch frame body 6 parameter"]:
        """How each body moves in the sensor's frame: left twist per unit of each parameter."""
        world, robot = self._base_motion(state)
        mount = -torch.eye(6, dtype=state.dtype, device=state.device).expand_as(world)
        motions = [torch.cat([base, mount], -1) @ self.columns for base in (world, robot)]
        on_robot = self.on_robot[:, None, None]
        return torch.where(on_robot, motions[1][..., None, :, :], motions[0][..., None, :, :])

    def _base_motion(self, state: Tensor) -> tuple[Tensor, Tensor]:
        """Motion of the world and of the robot in the sensor's frame with the base's twist."""
        base, mount = state[..., None, 0, :, :], state[..., None, 1, :, :]
        if self.standing:
            robot = se3.adjoint(se3.inverse(mount) @ base)
            robot = robot.expand(*robot.shape[:-3], len(self.Ts_base_carrier), 6, 6)
            return torch.zeros_like(robot), robot
        world = -se3.adjoint(se3.inverse(self.Ts_base_carrier @ mount))
        return world, torch.zeros_like(world)

    def pose_jacobians(
        self, state: Float[Tensor, "*batch 2 4 4"]
    ) -> Float[Tensor, "*batch frame 6 parameter"]:
        """Twist on the right of each ``T_world_sensor`` per unit of each parameter."""
        world, _ = self._base_motion(state)
        mount = torch.eye(6, dtype=state.dtype, device=state.device).expand_as(world)
        return torch.cat([-world, mount], -1) @ self.columns


def _free_axes(job: Job) -> tuple[tuple[str, ...], Tensor, Tensor]:
    names, sigmas, columns = [], [], []
    eye = torch.eye(12, dtype=job.T_world_base.dtype, device=job.T_world_base.device)
    for offset, name, prior in ((0, "base", job.base), (6, "mount", job.mount)):
        for i, axis in enumerate(AXES):
            if prior is not None and prior.sigma[i] > 0:
                names.append(f"{name}.{axis}")
                sigmas.append(prior.sigma[i])
                columns.append(eye[offset + i])
    if not names:
        return (), eye.new_zeros(0), eye[:, :0]
    return tuple(names), torch.stack(sigmas).to(eye), torch.stack(columns, -1)


def _frame_pose(job: Job, index: int) -> Tensor:
    T = job.frames[index].T_world_sensor
    assert T is not None, "a job without a robot gives every frame a pose"
    return T


def _joints(job: Job) -> Tensor:
    return torch.stack([frame.joints for frame in job.frames if frame.joints is not None])


def _carriers(job: Job) -> Tensor:
    """Poses in the base of what carries the sensor, frame by frame."""
    if job.robot is None:
        first = se3.inverse(_frame_pose(job, 0))
        return torch.stack([first @ _frame_pose(job, k) for k in range(len(job.frames))])
    if job.link is None or job.link == WORLD_LINK:
        return torch.eye(4).to(job.T_world_base).expand(len(job.frames), 4, 4)
    links = job.robot.forward_kinematics(_joints(job))
    return links[:, job.robot.link_index(job.link)]


def _anchored_bodies(job: Job, scene: Scene) -> Tensor:
    """Poses of the bodies in the world, or in the base of the robot that they belong to."""
    origin = torch.eye(4).to(job.T_world_base)
    joints = None if job.robot is None else _joints(job)
    poses = body_poses(scene, job.world, job.robot, origin, joints)
    return poses.expand(len(job.frames), -1, 4, 4)
