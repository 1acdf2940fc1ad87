"""The unknown parameter vector q (eq. 3): its named parts, their prior, and what they move.

A state is a row of rigid motions, ``(*batch, slot, 4, 4)``, as ``mechanism`` describes it. Without
a robot the base is the first frame's sensor pose and the mount is the identity, so that
T_k = T_1 exp(xi) T_1^-1 T_k falls out of the same product.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.calibrate.mechanism import Mechanism, Placed, centre_of
from torchcal.calibrate.slots import BASE, MOUNT, Slots
from torchcal.geometry import se3
from torchcal.model.job import Frame, Job, PosePrior
from torchcal.model.scene import Scene

FARTHEST = 5.0
"""Prior sigmas: a state farther from the nominal one contradicts what was believed of it."""
AXES = ("x", "y", "z", "rx", "ry", "rz")

Unit = Literal["m", "rad", "1"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Parameters:
    """Names, prior and kinematics of everything that may be wrong in a job."""

    names: tuple[str, ...]
    """``base.x`` .., ``joints.NAME``, ``mount.x`` .., ``objects.NAME.x`` .., ``range.offset``,
    ``range.scale``, ``frames.1.x`` ..: those that are not held."""
    units: tuple[Unit, ...]
    prior_sigma: Float[Tensor, " parameter"]
    """In ``units``."""
    columns: Float[Tensor, "twist parameter"]
    """Unit columns: which axes of the slots' twists are free."""
    nominal: Float[Tensor, "slot 4 4"]
    mechanism: Mechanism
    joint_names: tuple[str, ...] = ()
    """Of ``mechanism.slots.joints``."""
    object_names: tuple[str, ...] = ()
    """Of ``mechanism.slots.objects``."""

    @staticmethod
    def of(job: Job, scene: Scene) -> "Parameters":
        """The parameters that the job declares unknown."""
        slots = _slots(job, scene)
        names, sigmas, columns = _free(job, slots)
        return Parameters(
            names=names,
            units=tuple(parameter_unit(name, job) for name in names),
            prior_sigma=sigmas,
            columns=columns,
            nominal=_nominal(job, scene, slots),
            mechanism=Mechanism.of(job, scene, slots),
            joint_names=tuple(job.joints),
            object_names=tuple(job.objects),
        )

    @property
    def prior_precision(self) -> Float[Tensor, " parameter"]:
        """1 / sigma^2 of the prior: what it adds to the diagonal of the normal equations."""
        return self.prior_sigma.double().square().reciprocal()

    def retract(
        self, state: Float[Tensor, "*batch slot 4 4"], step: Float[Tensor, "*batch parameter"]
    ) -> Float[Tensor, "*batch slot 4 4"]:
        """Moves a state by a step of the parameters: T exp(xi) in every slot."""
        twists = (step @ self.columns.mT).unflatten(-1, (-1, 6))
        return state @ se3.exp(twists)

    def difference(
        self, state: Float[Tensor, "*#batch slot 4 4"], origin: Float[Tensor, "*#batch slot 4 4"]
    ) -> Float[Tensor, "*batch parameter"]:
        """The parameters that lead from one state to another."""
        twists = se3.log(se3.inverse(origin) @ state).flatten(-2)
        return twists @ self.columns

    def from_nominal(
        self, state: Float[Tensor, "*batch slot 4 4"]
    ) -> Float[Tensor, "*batch parameter"]:
        """How far a state is from the nominal one, in prior sigmas."""
        return self.difference(state, self.nominal) / self.prior_sigma

    def contradicts_prior(self, state: Float[Tensor, "*batch slot 4 4"]) -> Bool[Tensor, "*batch"]:
        """Whether some parameter is more than ``FARTHEST`` prior sigmas from the nominal one."""
        return (self.from_nominal(state).abs() > FARTHEST).any(-1)

    def with_base(
        self, Ts_world_base: Float[Tensor, "*batch 4 4"]
    ) -> Float[Tensor, "*batch slot 4 4"]:
        """The nominal state with other bases; without a robot, poses of the first frame."""
        state = self.nominal.expand(*Ts_world_base.shape[:-2], *self.nominal.shape).clone()
        state[..., BASE, :, :] = Ts_world_base
        return state

    def at(self, frame: Frame, T_world_first: Float[Tensor, "4 4"]) -> "Parameters":
        """The same of another frame, which takes the place of the only one.

        Args:
            frame: What it has no joints or no pose of stays as it is.
            T_world_first: Nominal pose of the first frame; matters without a robot.
        """
        mechanism = self.mechanism
        if frame.joints is not None:
            mechanism = replace(mechanism, joints=frame.joints.to(mechanism.joints)[None])
        if frame.T_world_sensor is not None:
            T = se3.inverse(T_world_first) @ frame.T_world_sensor.to(T_world_first)
            mechanism = replace(mechanism, Ts_first_frame=T[None])
        return replace(self, mechanism=mechanism)

    def sensor_poses(
        self, state: Float[Tensor, "*batch slot 4 4"]
    ) -> Float[Tensor, "*batch frame 4 4"]:
        """``Ts_world_sensor`` of all frames."""
        return self.mechanism.at(state).Ts_world_sensor

    def bodies_in_sensor(
        self, state: Float[Tensor, "*batch slot 4 4"]
    ) -> Float[Tensor, "*batch frame body 4 4"]:
        """``Ts_sensor_body`` of all frames and bodies."""
        placed = self.mechanism.at(state)
        return se3.inverse(placed.Ts_world_sensor)[..., None, :, :] @ placed.Ts_world_body

    def motion(
        self, state: Float[Tensor, "*batch slot 4 4"], frame: int
    ) -> Float[Tensor, "*batch body 6 active"]:
        """How each body moves in a frame's sensor: left twist per unit of the active parameters."""
        return self._motion(self.mechanism.at(state), frame)

    def motions(
        self, state: Float[Tensor, "*batch slot 4 4"], frames: Iterable[int]
    ) -> Iterator[Float[Tensor, "*batch body 6 active"]]:
        """The same of several frames, one by one: what they share is worked out once."""
        placed = self.mechanism.at(state)
        return (self._motion(placed, frame) for frame in frames)

    def _motion(self, placed: Placed, frame: int) -> Tensor:
        T_sensor_world = se3.inverse(placed.Ts_world_sensor[..., frame, :, :])
        sensor = placed.sensor_twists(frame)[..., None, :, :]
        turned = se3.adjoint(T_sensor_world)[..., None, :, :]
        return turned @ (placed.body_twists(frame) - sensor) @ self.columns[:, self.active(frame)]

    def active(self, frame: int) -> Int[Tensor, " active"]:
        """The parameters that a frame's image may depend on: all but errors of other frames."""
        frames = self.mechanism.slots.of_frames
        others = [slot for slot in range(frames.start, frames.stop) if slot != frames.start + frame]
        of_others = self.columns.unflatten(0, (-1, 6))[others].any(0).any(0)
        return (~of_others).nonzero()[:, 0]

    def pose_jacobians(
        self, state: Float[Tensor, "*batch slot 4 4"]
    ) -> Float[Tensor, "*batch frame 6 parameter"]:
        """Twist on the right of each ``T_world_sensor`` per unit of each parameter."""
        placed = self.mechanism.at(state)
        frames = range(placed.Ts_world_sensor.shape[-3])
        left = torch.stack([placed.sensor_twists(k) for k in frames], -3)
        return se3.adjoint(se3.inverse(placed.Ts_world_sensor)) @ left @ self.columns

    @property
    def object_jacobians(self) -> Float[Tensor, "object 6 parameter"]:
        """Twist on the right of each unknown object's centre per unit of each parameter."""
        return self.columns.unflatten(0, (-1, 6))[self.mechanism.slots.of_objects]

    def joint_offsets(
        self, state: Float[Tensor, "*batch slot 4 4"]
    ) -> Float[Tensor, "*batch offset"]:
        """The offsets (rad, m) of ``mechanism.slots.joints``."""
        return state[..., self.mechanism.slots.of_joints, 0, 3]

    def object_poses(
        self, state: Float[Tensor, "*batch slot 4 4"]
    ) -> Float[Tensor, "*batch object 4 4"]:
        """``Ts_world_object`` of ``mechanism.slots.objects``."""
        centres = state[..., self.mechanism.slots.of_objects, :, :]
        return centres @ self.mechanism.Ts_centre_object

    def range_error(self, state: Float[Tensor, "*batch slot 4 4"]) -> Float[Tensor, "*batch 2"]:
        """Offset (m) and scale of the sensor: z_measured = offset + (1 + scale) z."""
        if not self.mechanism.slots.ranges:
            return state.new_zeros(*state.shape[:-3], 2)
        return state[..., self.mechanism.slots.of_ranges, 0, 3]

    @property
    def range_parameters(self) -> tuple[int | None, int | None]:
        """The places of offset and scale among the parameters; None where one is not free."""
        places = {name: place for place, name in enumerate(self.names)}
        return places.get("range.offset"), places.get("range.scale")


def _slots(job: Job, scene: Scene) -> Slots:
    robot = job.robot
    return Slots(
        joints=tuple(robot.joint_names.index(name) for name in job.joints) if robot else (),
        objects=tuple(scene.body_index(name) for name in job.objects),
        frames=len(job.frames) if job.frame_poses is not None else 0,
        ranges=2 if job.range is not None else 0,
    )


def _nominal(job: Job, scene: Scene, slots: Slots) -> Float[Tensor, "slot 4 4"]:
    first = job.frames[0].T_world_sensor
    state = torch.eye(4).to(job.T_world_base).repeat(slots.count, 1, 1)
    state[BASE] = job.T_world_base if job.robot is not None or first is None else first
    state[MOUNT] = job.T_link_sensor
    known = {item.name: item.T_world_object for item in job.world.objects} if job.world else {}
    for place, name in enumerate(job.objects):
        centre = torch.eye(4).to(state)
        centre[:3, 3] = centre_of(scene, slots.objects[place])
        state[slots.of_objects.start + place] = known[name].to(state) @ centre
    return state


def _free(job: Job, slots: Slots) -> tuple[tuple[str, ...], Tensor, Tensor]:
    """Names, sigmas and columns of everything with a sigma above 0."""
    like = job.T_world_base
    free = [(name, place, sigma) for name, place, sigma in _sigmas(job, slots) if sigma > 0]
    columns = like.new_zeros(6 * slots.count, len(free))
    for parameter, (_, place, _) in enumerate(free):
        columns[place, parameter] = 1.0
    sigmas = torch.tensor([sigma for _, _, sigma in free], dtype=like.dtype, device=like.device)
    return tuple(name for name, _, _ in free), sigmas, columns


def _sigmas(job: Job, slots: Slots) -> Iterator[tuple[str, int, float]]:
    """Name, place among the twists of a state and sigma of everything that may be unknown."""
    yield from _of_pose("base", BASE, job.base)
    for place, (name, sigma) in enumerate(job.joints.items()):
        yield f"joints.{name}", 6 * (slots.of_joints.start + place), sigma
    yield from _of_pose("mount", MOUNT, job.mount)
    for place, (name, prior) in enumerate(job.objects.items()):
        yield from _of_pose(f"objects.{name}", slots.of_objects.start + place, prior)
    if job.range is not None:
        first = 6 * slots.of_ranges.start
        yield "range.offset", first, job.range.offset_sigma
        yield "range.scale", first + 6, job.range.scale_sigma
    for k in range(slots.frames):
        yield from _of_pose(f"frames.{k + 1}", slots.of_frames.start + k, job.frame_poses)


def parameter_unit(name: str, job: Job) -> Unit:
    """The unit of a parameter by its name, such as ``base.rx`` or ``joints.elbow``."""
    block, _, rest = name.partition(".")
    if block == "joints" and job.robot is not None:
        return job.robot.joint_unit(rest)
    if name == "range.scale":
        return "1"
    return "rad" if rest.rpartition(".")[2] in AXES[3:] else "m"


def _of_pose(name: str, slot: int, prior: PosePrior | None) -> Iterator[tuple[str, int, float]]:
    sigmas = [] if prior is None else prior.sigma.tolist()
    for place, (axis, sigma) in enumerate(zip(AXES, sigmas, strict=False)):
        yield f"{name}.{axis}", 6 * slot + place, sigma
