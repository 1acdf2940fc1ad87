"""The measured images at one resolution, ready to be compared with predicted ones."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from torchcal.calibrate.repeats import repeats
from torchcal.model.job import Job
from torchcal.model.sensor import Sensor
from torchcal.render.sharing import JUMP

MASK_MARGIN = 5
"""Pixels inside a mask's border that are left out: a sharp sensor's ranges and the mask itself are
wrong there in the same way all along the border."""
COARSE_SIDE = 60
"""A coarse image has about so many pixels along its shorter side."""
COARSEST = 8
"""Most pixels along the side of a block that one pixel of a coarse image stands for."""
SMALLEST = 64
"""Images are not cropped to fewer pixels than this along a side."""
ROUNDING = 1e-4
"""Of a mean over up to a thousand ones."""
SURE = 15.0
"""Sigmas of a pixel that a step off the neighbours' plane must have to be a jump: six of those
of a second difference."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Observation:
    """All frames of a recording at one resolution."""

    sensor: Sensor
    range: Float[Tensor, "frame h w"]
    """m; 0 where ``measured`` is false."""
    measured: Bool[Tensor, "frame h w"]
    """Pixels that the estimate may use."""
    sigma: Float[Tensor, "frame h w"]
    """Independent noise of each pixel (m)."""

    def without(self, excluded: Bool[Tensor, "frame h w"]) -> "Observation":
        """The same without some pixels."""
        return replace(self, measured=self.measured & ~excluded)

    def part(self, rows: slice, columns: slice) -> "Observation":
        """A rectangle of the same images, as a sensor of that size sees it."""
        width, height = columns.stop - columns.start, rows.stop - rows.start
        projection = self.sensor.projection.cropped(columns.start, rows.start, width, height)
        own = (slice(None), rows, columns)
        return Observation(
            sensor=replace(self.sensor, projection=projection),
            range=self.range[own],
            measured=self.measured[own],
            sigma=self.sigma[own],
        )


def observe(job: Job, *, dtype: torch.dtype = torch.float32) -> Observation:
    """The job's images at full resolution, without the pixels at depth jumps of sharp sensors.

    An image that is there several times, taken from the same place, is measured once.
    """
    ranges = torch.stack([frame.image.range for frame in job.frames]).to(dtype)
    usable = torch.stack([frame.image.usable for frame in job.frames])
    observation = observed(ranges, usable, job.sensor)
    again = torch.zeros_like(observation.measured)
    again[list(repeats(job))] = True
    return observation.without(again)


def observed(
    ranges: Float[Tensor, "frame h w"], usable: Bool[Tensor, "frame h w"], sensor: Sensor
) -> Observation:
    """Images (m) at full resolution, without the pixels at depth jumps of sharp sensors.

    Args:
        ranges: Not finite where nothing was measured.
        usable: What may be used.
        sensor: What measured them.
    """
    measured = usable & ranges.isfinite()
    sigma = sensor.noise.sigma(ranges.nan_to_num(1.0))
    if sensor.beam <= 1:
        # Real cameras mix or invent ranges at jumps; a wide beam mixes them as eq. 17 says.
        measured = measured & ~near_jumps(ranges, measured, sigma)
        if not usable.all():
            measured = measured & ~grown(~usable, MASK_MARGIN)
    return Observation(
        sensor=sensor,
        range=torch.where(measured, ranges, 0.0),
        measured=measured,
        sigma=sigma,
    )


def coarse_images(job: Job) -> Observation:
    """What a start is sought on: the measured part of a job's images, coarse and sharpened."""
    observation = cropped(observe(job))
    return sharpened(coarser(observation, coarse_factor(observation.sensor)))


def cropped(observation: Observation) -> Observation:
    """The part of the images that was measured in some frame.

    Only for beams of a pixel: a wide beam's mean at the border depends on where the border is.
    """
    if observation.sensor.beam > 1 or not observation.measured.any():
        return observation
    rows, columns = (observation.measured.any(0).any(axis).nonzero()[:, 0] for axis in (1, 0))
    if min(rows[-1] - rows[0], columns[-1] - columns[0]) < SMALLEST:
        return observation
    return observation.part(
        slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    )


def coarser(observation: Observation, factor: int, *, least: float = 0.5) -> Observation:
    """Means over blocks of ``factor`` x ``factor`` pixels.

    Args:
        observation: The images.
        factor: Side of a block (pixels).
        least: Share of a block's pixels that must be measured. The mean of some of them is that of
            a place a little beside the block's middle.
    """
    if factor == 1:
        return observation
    sensor = observation.sensor
    count = _block_mean(observation.measured.to(observation.range), factor)
    enough = count >= least - ROUNDING
    safe = torch.where(enough, count, 1.0)
    ranges = _block_mean(observation.range, factor) / safe
    sigma = _block_mean(torch.where(observation.measured, observation.sigma, 0.0), factor) / safe
    return Observation(
        sensor=coarser_sensor(sensor, factor),
        range=torch.where(enough, ranges, 0.0),
        measured=enough,
        sigma=torch.where(enough, sigma / factor, 1.0),
    )


def coarse_factor(sensor: Sensor) -> int:
    """Side of the blocks of pixels that one pixel of a coarse image stands for."""
    shorter = min(sensor.projection.width, sensor.projection.height)
    return max(1, min(COARSEST, shorter // COARSE_SIDE))


def coarser_sensor(sensor: Sensor, factor: int) -> Sensor:
    """The sensor whose pixels cover ``factor`` x ``factor`` of these; its beam is about as wide."""
    beam = coarser_beam(sensor.beam, factor) if sensor.beam else 0
    return replace(sensor, projection=sensor.projection.resized(factor), beam=beam)


def coarser_beam(beam: int, factor: int) -> int:
    """The odd number of blocks of ``factor`` pixels that is nearest to a beam (pixels)."""
    return max(1, 2 * round((beam / factor - 1) / 2) + 1)


def sharpened(observation: Observation) -> Observation:
    """The same for a start: pixels of a sharp sensor are compared with the ray in their middle.

    That is a fraction of the work of their area where a coarse pixel shows many faces of a mesh.
    """
    if observation.sensor.beam > 1:
        return observation
    return replace(observation, sensor=replace(observation.sensor, beam=0))


def _block_mean(images: Tensor, factor: int) -> Tensor:
    return functional.avg_pool2d(images[:, None], factor)[:, 0]


def near_jumps(
    ranges: Float[Tensor, "frame h w"], measured: Bool[Tensor, "frame h w"], sigma: Tensor
) -> Bool[Tensor, "frame h w"]:
    """Pixels within two of a depth jump: a bend in inverse range, which is straight on a plane."""
    # A frame at a time: the images of a long recording are not held several times over.
    frames = zip(ranges.split(1), measured.split(1), sigma.split(1), strict=True)
    return grown(torch.cat([_bent(*frame) for frame in frames]) & measured, 1)


def _bent(ranges: Tensor, measured: Tensor, sigma: Tensor) -> Bool[Tensor, "frame h w"]:
    """Pixels whose neighbours are on no plane with them."""
    inverse = torch.where(measured, ranges, torch.nan).reciprocal()
    bend = torch.maximum(_bend(inverse), _bend(inverse.mT).mT) * ranges.square()
    return bend > torch.maximum(JUMP * ranges, SURE * sigma)


def grown(mask: Bool[Tensor, "frame h w"], pixels: int) -> Bool[Tensor, "frame h w"]:
    """The masks and everything within so many pixels of them along rows and columns."""
    # First along columns, then along rows: a square at once takes many times as long.
    return _widened(_widened(mask, pixels).mT, pixels).mT


def _bend(images: Tensor) -> Tensor:
    """Size of the second difference along rows; 0 at the ends and beside what is missing."""
    if images.shape[-1] < 3:
        return torch.zeros_like(images)
    middle = (images[..., 2:] + images[..., :-2] - 2.0 * images[..., 1:-1]).abs()
    return functional.pad(middle.nan_to_num(0.0), (1, 1))


def _widened(mask: Tensor, pixels: int) -> Tensor:
    """Everything within so many pixels along the rows' direction of what is set."""
    wide, reach = mask, 0
    while reach < pixels:
        # What was widened before is shifted as far again: few passes reach far.
        step = min(reach + 1, pixels - reach)
        before, wide = wide, wide.clone()
        wide[..., step:, :] |= before[..., :-step, :]
        wide[..., :-step, :] |= before[..., step:, :]
        reach += step
    return wide
