"""What a calibration finds: the estimate, the comparison and the update, as frozen data."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum

import torch
import trimesh
from jaxtyping import Bool, Float, Float16, Int32, UInt8
from torch import Tensor

from torchcal.model.job import Job


class Status(StrEnum):
    """Whether the answer can be used."""

    CONVERGED = "converged"
    AMBIGUOUS = "ambiguous"
    UNOBSERVABLE = "unobservable"
    FAILED = "failed"


def rivals_words(count: int, what: str) -> str:
    """The beginning of a sentence: so many other poses explain "the image" or "the images"."""
    others = "1 other pose explains" if count == 1 else f"{count} other poses explain"
    return f"{others} {what} as well"


class PixelClass(IntEnum):
    """What the comparison of eq. 5 says of a pixel."""

    NOT_COMPARED = 0
    """Outside the mask, or neither measured nor modelled."""
    AGREES = 1
    NEARER = 2
    """The measurement is nearer than the model: something stands before it."""
    FARTHER = 3
    """The measurement is farther than the model: the sensor saw through it."""
    MISSING = 4
    """The model is there and nothing was measured."""
    UNMODELLED = 5
    """Something was measured where the model is empty."""


@dataclass(frozen=True, kw_only=True, slots=True)
class UnobservableDirection:
    """A direction of the parameters that the images say nothing about."""

    words: str
    vector: Float[Tensor, " parameter"]
    """Unit vector in parameters divided by their prior sigmas."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Alternative:
    """Another pose that explains the images too, or nearly."""

    Ts_world_sensor: Float[Tensor, "frame 4 4"]
    score: float
    """Robust cost per usable pixel; the estimate's own is ``Estimate.score``."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Estimate:
    """The estimated parameters and how sure they are (section 3)."""

    status: Status
    message: str
    """One sentence for a person."""
    names: tuple[str, ...]
    """``base.x`` .. ``mount.rz``: the order of ``covariance``; held axes are left out."""
    covariance: Float[Tensor, "parameter parameter"]
    """P of eq. 3 (m, rad) of the twists on the right of the estimated poses."""
    state: Float[Tensor, "slot 4 4"]
    """All that follows here, as ``Parameters`` has it."""
    T_world_base: Float[Tensor, "4 4"]
    T_link_sensor: Float[Tensor, "4 4"]
    Ts_world_sensor: Float[Tensor, "frame 4 4"]
    pose_covariances: Float[Tensor, "frame 6 6"]
    """Of the twist on the right of each ``Ts_world_sensor``."""
    joint_offsets: Mapping[str, float]
    """rad or m: what must be added to the values of the joints that were unknown."""
    Ts_world_object: Mapping[str, Float[Tensor, "4 4"]]
    """Of the objects whose pose was unknown."""
    range_offset: float
    """m: z_measured = offset + (1 + scale) z"""
    range_scale: float
    moved: tuple[str, ...]
    """Objects whose pose differs from the model's by more than chance explains."""
    sigma_scale: float
    """How much larger the residuals are than the job's sigma says; at least 1."""
    drift_sigma: float
    """The slowly varying range error (m) that was used or estimated."""
    drift_pixels: float
    """Its correlation length (pixels)."""
    estimated: bool = True
    """False: the images were compared at the nominal pose."""
    used_pixels: int = 0
    """Measured pixels of all frames that the fit went by; 0 where nothing was estimated."""
    independent_pixels: float = 0.0
    """So many pixels, with errors as large but each its own, would have told as much (the ellipsoid
    of what the images tell would have the same volume): neighbouring pixels err alike."""
    score: float
    unobservable: tuple[UnobservableDirection, ...]
    alternatives: tuple[Alternative, ...]

    def to(self, dtype: torch.dtype) -> "Estimate":
        """The same with poses and covariances in another precision."""
        return replace(
            self,
            covariance=self.covariance.to(dtype),
            state=self.state.to(dtype),
            T_world_base=self.T_world_base.to(dtype),
            T_link_sensor=self.T_link_sensor.to(dtype),
            Ts_world_sensor=self.Ts_world_sensor.to(dtype),
            pose_covariances=self.pose_covariances.to(dtype),
            Ts_world_object={name: T.to(dtype) for name, T in self.Ts_world_object.items()},
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class FrameComparison:
    """One frame, pixel by pixel (eq. 1, 4 and 5).

    Long recordings have many of them, so what needs few bits has few.
    """

    name: str
    measured: Float[Tensor, "h w"]
    """m; NaN where nothing was measured."""
    predicted: Float[Tensor, "h w"]
    """m; NaN where the model is empty."""
    sigma: Float[Tensor, "h w"]
    """sigma' of eq. 4 (m); NaN where the model is empty."""
    label: UInt8[Tensor, "h w"]
    """One ``PixelClass`` per pixel."""
    body: Int32[Tensor, "h w"]
    """Index into ``Scene.bodies`` of what the model shows; -1 where it is empty."""
    colour: UInt8[Tensor, "h w 3"]
    """The model's own colours, unshaded, 0 to 255; 0 where it is empty."""
    normal: Float16[Tensor, "h w 3"]
    """Unit normals of the model towards the sensor, sensor frame; 0 where it is empty."""
    usable: Bool[Tensor, "h w"]


class Verdict(StrEnum):
    """What the images say of an object of the world."""

    AGREES = "agrees"
    MOVED = "moved"
    REMOVED = "removed"
    UNSEEN = "unseen"
    """Too few pixels show it or see through it."""

    @property
    def is_change(self) -> bool:
        """Whether the object is not where the model has it."""
        return self in (Verdict.MOVED, Verdict.REMOVED)


@dataclass(frozen=True, kw_only=True, slots=True)
class ObjectVerdict:
    """The verdict on one object of the world, and the pixels that it rests on."""

    verdict: Verdict
    agree: int
    seen_through: int
    hidden: int
    T_world_object: Float[Tensor, "4 4"] | None = None
    """Where it is now, if it moved, or if its pose was unknown and was estimated elsewhere."""
    frames: tuple[str, ...] = ()
    """Those that say so: that see through it if it was removed, else that show it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Evidence:
    """What the pixels of all frames say of one proposed change."""

    supporting: int
    """Pixels that show the change."""
    contradicting: int
    """Pixels that show the model as it was, or that see through what is proposed."""
    hidden: int
    """Pixels in which something nearer stands before it: they say nothing."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AddedObject:
    """Something that was measured and is not in the model."""

    name: str
    frames: tuple[str, ...]
    mesh: trimesh.Trimesh
    """World frame, metres."""
    evidence: Evidence


class Change(StrEnum):
    """What a proposal does to the model."""

    REMOVE = "remove"
    MOVE = "move"
    ADJUST = "adjust"
    """To where it was estimated, which by chance alone may be where the model has it."""
    ADD = "add"


@dataclass(frozen=True, kw_only=True, slots=True)
class Proposal:
    """One change of the model that a person may accept or reject (2.5)."""

    name: str
    change: Change
    evidence: Evidence
    frames: tuple[str, ...]
    """Those whose pixels speak for it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Update:
    """The proposed changes of the model (2.5)."""

    verdicts: dict[str, ObjectVerdict]
    added: tuple[AddedObject, ...]

    @property
    def proposals(self) -> tuple[Proposal, ...]:
        """Every change of the model: objects removed, moved and adjusted, then those added."""
        changed = [
            Proposal(name=name, change=change, evidence=evidence, frames=verdict.frames)
            for name, verdict in self.verdicts.items()
            for change, evidence in _changes(verdict)
        ]
        added = [
            Proposal(name=item.name, change=Change.ADD, evidence=item.evidence, frames=item.frames)
            for item in self.added
        ]
        return (*changed, *added)


def _changes(verdict: ObjectVerdict) -> list[tuple[Change, Evidence]]:
    """The change, at most one, that a verdict asks for."""
    through, agree, hidden = verdict.seen_through, verdict.agree, verdict.hidden
    if verdict.verdict is Verdict.REMOVED:
        return [(Change.REMOVE, Evidence(supporting=through, contradicting=agree, hidden=hidden))]
    there = Evidence(supporting=agree, contradicting=through, hidden=hidden)
    if verdict.verdict is Verdict.MOVED:
        return [(Change.MOVE, there)]
    return [] if verdict.T_world_object is None else [(Change.ADJUST, there)]


@dataclass(frozen=True, kw_only=True, slots=True)
class NextView:
    """Where to look next: the joint configuration whose image would tell most."""

    joints: Mapping[str, float]
    """rad or m, within the limits; nobody looked whether the robot can stand there."""
    gain: float
    """Information (nats) that its image adds."""
    sigma: Mapping[str, float]
    """What would be left of each parameter's standard deviation."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Calibration:
    """The whole answer to a job."""

    job: Job
    estimate: Estimate
    comparisons: tuple[FrameComparison, ...]
    update: Update
    next_view: NextView | None
    """None without joints that could be moved, or where nothing was estimated."""
    warnings: tuple[str, ...]
    """What looks wrong in the job although it could be read, in sentences."""
    timing: dict[str, float]
    """Seconds for each stage."""
    seed: int | None = None
    """Of the generator that starts were drawn with; None where nobody knows."""
