"""What hangs on what: where sensor and bodies are in every frame, and how parts of q move them.

A state is a row of rigid motions, ``(*batch, slot, 4, 4)``: the base, the mount, then joint
offsets, objects, the errors of single frames and of the sensor's range, as far as they are unknown.
A step is a twist on the right of each. A plain number is kept as a motion along x: it adds up, and
all that holds for poses holds for numbers.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.calibrate.slots import BASE, MOUNT, Slots
from torchcal.geometry import se3
from torchcal.model.job import WORLD_LINK, Job
from torchcal.model.robot import Robot
from torchcal.model.scene import Scene


@dataclass(frozen=True, kw_only=True, slots=True)
class Mechanism:
    """The kinematics of a recording: everything that does not change with q."""

    slots: Slots
    robot: Robot | None
    joints: Float[Tensor, "frame joint"]
    """As they were read; none without a robot."""
    carrier: int | None
    """The robot's link that carries the sensor; None without one."""
    standing: bool
    """The sensor stands still in the world: its pose is the mount alone."""
    Ts_first_frame: Float[Tensor, "frame 4 4"]
    """Without a robot: every frame's nominal sensor pose in the first one's."""
    Ts_world_body: Float[Tensor, "body 4 4"]
    """Of the bodies that stand still."""
    link: Int[Tensor, " body"]
    """The robot's link that a body is; -1 for objects."""
    Ts_centre_object: Float[Tensor, "object 4 4"]
    """From the centre of each unknown object to its own frame."""

    @staticmethod
    def of(job: Job, scene: Scene, slots: Slots) -> "Mechanism":
        """The kinematics of a job whose unknowns have these slots."""
        return Mechanism(
            slots=slots,
            robot=job.robot,
            joints=_joints(job),
            carrier=_carrier(job),
            standing=job.link == WORLD_LINK,
            Ts_first_frame=_from_first(job),
            Ts_world_body=_standing_bodies(job, scene),
            link=_links(job, scene),
            Ts_centre_object=se3.inverse(_centres(scene, slots.objects)).to(job.T_world_base),
        )

    def at(self, state: Float[Tensor, "*batch slot 4 4"]) -> "Placed":
        """Everything in its place at a state."""
        links = None
        if self.robot is not None:
            links = self.robot.forward_kinematics(self._joint_values(state))
        return Placed(
            mechanism=self,
            state=state,
            Ts_base_link=links,
            Ts_world_sensor=self._sensor_poses(state, links),
        )

    @property
    def moving_alike(self) -> Int[Tensor, " body"]:
        """For each body the first of those that keep their places to each other in any frame."""
        of_robot = self.link if self.slots.joints else self.link.clamp(max=0)
        group = torch.where(self.link >= 0, of_robot, -1)
        for place, body in enumerate(self.slots.objects):
            group[body] = -2 - place
        return (group[:, None] == group).int().argmax(1)

    def _joint_values(self, state: Tensor) -> Float[Tensor, "*batch frame joint"]:
        offsets = state.new_zeros(*state.shape[:-3], self.joints.shape[-1])
        offsets[..., list(self.slots.joints)] = state[..., self.slots.of_joints, 0, 3]
        return self.joints + offsets[..., None, :]

    def _sensor_poses(self, state: Tensor, links: Tensor | None) -> Tensor:
        base, mount = state[..., None, BASE, :, :], state[..., None, MOUNT, :, :]
        if self.standing:
            poses = mount.expand(*state.shape[:-3], len(self.Ts_first_frame), 4, 4)
        elif self.carrier is None or links is None:
            poses = base @ self.Ts_first_frame @ mount
        else:
            poses = base @ links[..., self.carrier, :, :] @ mount
        own = state[..., self.slots.of_frames, :, :]
        return poses @ own if self.slots.frames else poses


@dataclass(frozen=True, kw_only=True, slots=True)
class Placed:
    """Where sensor and bodies are at a state, and how they move from there."""

    mechanism: Mechanism
    state: Float[Tensor, "*batch slot 4 4"]
    Ts_base_link: Float[Tensor, "*batch frame link 4 4"] | None
    """None without a robot."""
    Ts_world_sensor: Float[Tensor, "*batch frame 4 4"]

    @property
    def Ts_world_body(self) -> Float[Tensor, "*batch frame body 4 4"]:
        """Of all frames and bodies."""
        mechanism, state = self.mechanism, self.state
        standing = mechanism.Ts_world_body
        poses = standing.expand(*self.Ts_world_sensor.shape[:-2], *standing.shape).clone()
        moving = mechanism.link >= 0
        if self.Ts_base_link is not None and moving.any():
            links = self.Ts_base_link[..., mechanism.link[moving], :, :]
            poses[..., moving, :, :] = state[..., None, None, BASE, :, :] @ links
        if mechanism.slots.objects:
            centres = state[..., None, mechanism.slots.of_objects, :, :]
            poses[..., list(mechanism.slots.objects), :, :] = centres @ mechanism.Ts_centre_object
        return poses

    def sensor_twists(self, frame: int) -> Float[Tensor, "*batch 6 twist"]:
        """How a frame's sensor moves: twist on its left, in the world, for the slots' twists."""
        slots, state = self.mechanism.slots, self.state
        sensor = se3.adjoint(self.Ts_world_sensor[..., frame, :, :])
        twists = sensor.new_zeros(*state.shape[:-2], 6, 6)
        twists[..., MOUNT, :, :] = sensor
        if slots.frames:
            twists[..., slots.of_frames.start + frame, :, :] = sensor
        if not self.mechanism.standing:
            twists[..., BASE, :, :] = se3.adjoint(state[..., BASE, :, :])
        if self.mechanism.carrier is not None and slots.joints:
            by_joints = self._joint_twists(frame)[..., self.mechanism.carrier, :, :]
            twists[..., slots.of_joints, :, 0] = by_joints.mT
        return twists.movedim(-3, -2).flatten(-2)

    def body_twists(self, frame: int) -> Float[Tensor, "*batch body 6 twist"]:
        """The same for every body."""
        slots, link, state = self.mechanism.slots, self.mechanism.link, self.state
        twists = state.new_zeros(*state.shape[:-3], len(link), slots.count, 6, 6)
        moving = (link >= 0).nonzero()[:, 0]
        if len(moving):
            twists[..., moving, BASE, :, :] = se3.adjoint(state[..., None, BASE, :, :])
        if len(moving) and slots.joints:
            by_joints = self._joint_twists(frame)[..., link[moving], :, :]
            for place, column in enumerate(range(*slots.of_joints.indices(slots.count))):
                twists[..., moving, column, :, 0] = by_joints[..., place]
        first = slots.of_objects.start
        for place, body in enumerate(slots.objects):
            own = se3.adjoint(state[..., first + place, :, :])
            twists[..., body, first + place, :, :] = own
        return twists.movedim(-3, -2).flatten(-2)

    def _joint_twists(self, frame: int) -> Float[Tensor, "*batch link 6 joint"]:
        """How the links of a frame move with the unknown offsets: twists in the world."""
        robot = self.mechanism.robot
        assert robot is not None, "only robots have joints"
        assert self.Ts_base_link is not None, "only robots have links"
        twists = robot.jacobians(self.Ts_base_link[..., frame, :, :, :])
        in_world = se3.adjoint(self.state[..., None, BASE, :, :]) @ twists
        return in_world[..., list(self.mechanism.slots.joints)]


def centre_of(scene: Scene, body: int) -> Float[Tensor, "3"]:
    """The centre (m) of a body's bounding box, in its own frame."""
    points = scene.surface.vertices[scene.surface.vertex_body == body].double()
    return 0.5 * (points.amin(0) + points.amax(0))


def _centres(scene: Scene, bodies: tuple[int, ...]) -> Float[Tensor, "object 4 4"]:
    """``Ts_object_centre``: the axes are the object's own."""
    poses = torch.eye(4).to(scene.surface.vertices).double().repeat(len(bodies), 1, 1)
    for place, body in enumerate(bodies):
        poses[place, :3, 3] = centre_of(scene, body)
    return poses


def _carrier(job: Job) -> int | None:
    if job.robot is None or job.link is None or job.link == WORLD_LINK:
        return None
    return job.robot.link_index(job.link)


def _joints(job: Job) -> Float[Tensor, "frame joint"]:
    values = [frame.joints for frame in job.frames if frame.joints is not None]
    return torch.stack(values) if values else job.T_world_base.new_zeros(len(job.frames), 0)


def _from_first(job: Job) -> Float[Tensor, "frame 4 4"]:
    poses = [frame.T_world_sensor for frame in job.frames if frame.T_world_sensor is not None]
    if not poses:
        return torch.eye(4).to(job.T_world_base).expand(len(job.frames), 4, 4)
    return se3.inverse(poses[0]) @ torch.stack(poses)


def _standing_bodies(job: Job, scene: Scene) -> Float[Tensor, "body 4 4"]:
    """``Ts_world_body`` of objects; links have the identity."""
    poses = torch.eye(4).to(job.T_world_base).repeat(len(scene.bodies), 1, 1)
    objects = () if job.world is None else job.world.objects
    for body, item in enumerate(objects):
        poses[body] = item.T_world_object.to(poses)
    return poses


def _links(job: Job, scene: Scene) -> Int[Tensor, " body"]:
    links = [
        job.robot.link_index(body.link) if job.robot and body.link is not None else -1
        for body in scene.bodies
    ]
    return torch.tensor(links, device=job.T_world_base.device)
