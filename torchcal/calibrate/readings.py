"""Other ways in which a recording may have been meant: what fits far better is worth a warning."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.observation import coarse_images
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.range_fit import RangeFit
from torchcal.calibrate.refine import coarse_fit
from torchcal.geometry import robust
from torchcal.geometry.projection import Pinhole, pixel_grid
from torchcal.model.job import Job
from torchcal.model.scene import Scene
from torchcal.model.sensor import Sensor

EXPLAINED = 0.85
"""Share of the measured blocks from which on nothing else is tried."""
FAR_BETTER = 0.5
"""What fits far better leaves less than this part of the blocks unexplained that are so now..."""
LEAST = 0.5
"""... and explains at least this share of all."""
LEAST_FRAMES = 3
"""From so many on, frames may be paired with the joints of their neighbours."""
STEEPEST = 0.05
"""Cosine to the optical axis below which a depth along it says nothing of the distance."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Reading:
    """A mistake that a person may have made."""

    words: str
    """Complete the sentence "The images fit far better ..."."""
    of: Callable[[Job], Job | None]
    """The job as it was meant then; None where the mistake cannot have been made."""


def misreadings(
    job: Job, scene: Scene, parameters: Parameters, state: Float[Tensor, "slot 4 4"]
) -> tuple[str, ...]:
    """A warning, if the images fit far better when they are read in another way.

    Args:
        job: Its images, and its frames' joints.
        scene: What they should show.
        parameters: What is unknown; with nothing unknown there is nothing to fit, and no warning.
        state: Where to start: the nominal state, or one that was estimated.
    """
    if not parameters.names:
        return ()
    share = _explained(job, scene, parameters, state)
    if share >= EXPLAINED:
        return ()
    shares = {
        reading.words: _explained(meant, scene, Parameters.of(meant, scene), parameters.nominal)
        for reading in READINGS
        if (meant := reading.of(job)) is not None
    }
    words = max(shares, key=lambda each: shares[each])
    if shares[words] < max(LEAST, 1.0 - FAR_BETTER * (1.0 - share)):
        return ()
    return (
        f"The images fit far better {words}: the model then explains {shares[words]:.0%} "
        f"of what was measured instead of {share:.0%}.",
    )


def _explained(job: Job, scene: Scene, parameters: Parameters, state: Tensor) -> float:
    """Share of the measured blocks of pixels that a first fit brings to where the model is."""
    coarse = coarse_images(job)
    if not coarse.measured.any():
        return 0.0
    fit, solution = coarse_fit(coarse, scene.surface, parameters, state[None])
    return _agreeing(fit, solution.state[0])


def _agreeing(fit: RangeFit, state: Tensor) -> float:
    observation = fit.observation
    agreeing = 0
    for frame, ranges in zip(fit.residuals(state), observation.range, strict=True):
        sigma = observation.sensor.noise.sigma(ranges)
        agreeing += int(((frame.residual.abs() <= robust.AGREEING * sigma) & frame.compared).sum())
    return agreeing / int(observation.measured.sum())


def _turned(job: Job, turn: Callable[[Tensor], Tensor]) -> Job:
    """The job with every image and mask turned."""
    frames = tuple(
        replace(
            frame,
            image=replace(
                frame.image, range=turn(frame.image.range), usable=turn(frame.image.usable)
            ),
        )
        for frame in job.frames
    )
    return replace(job, frames=frames)


def _transposed(job: Job) -> Job | None:
    projection = job.sensor.projection
    return _turned(job, lambda image: image.mT) if projection.width == projection.height else None


def _along_the_other(job: Job) -> Job:
    """Distances along the ray for depths along z, or the other way round."""
    factor = _other_by_own(job.sensor).to(job.frames[0].image.range)
    frames = tuple(
        replace(frame, image=replace(frame.image, range=frame.image.range * factor))
        for frame in job.frames
    )
    return replace(job, frames=frames)


def _other_by_own(sensor: Sensor) -> Float[Tensor, "h w"]:
    """By what a range must be multiplied if the image holds the other kind of range."""
    u, v = pixel_grid(sensor.projection, dtype=torch.float64, device=torch.device("cpu"))
    rays = sensor.projection.rays(u, v)
    cosine = rays[..., 2] / rays.norm(dim=-1)
    if isinstance(sensor.projection, Pinhole):
        return cosine
    return torch.where(cosine > STEEPEST, cosine.reciprocal(), torch.nan)


def _shifted_joints(by: int) -> Callable[[Job], Job | None]:
    """Every image with the joints of the frame before (-1) or after (1) it."""

    def shift(job: Job) -> Job | None:
        if job.robot is None or len(job.frames) < LEAST_FRAMES:
            return None
        kept = job.frames[max(0, -by) : len(job.frames) - max(0, by)]
        joints = [frame.joints for frame in job.frames[max(0, by) :]]
        frames = (replace(frame, joints=q) for frame, q in zip(kept, joints, strict=False))
        return replace(job, frames=tuple(frames))

    return shift


READINGS = (
    Reading(words="mirrored left to right", of=lambda job: _turned(job, lambda x: x.flip(-1))),
    Reading(words="mirrored top to bottom", of=lambda job: _turned(job, lambda x: x.flip(-2))),
    Reading(words="turned by half a turn", of=lambda job: _turned(job, lambda x: x.flip(-1, -2))),
    Reading(words="with rows and columns exchanged", of=_transposed),
    Reading(
        words="if they hold the other kind of range, distance along the ray instead of depth "
        "along the optical axis or the reverse",
        of=_along_the_other,
    ),
    Reading(words="with the joints of the frame before each", of=_shifted_joints(-1)),
    Reading(words="with the joints of the frame after each", of=_shifted_joints(1)),
)
"""Mistakes that leave an image that can be read."""
