"""Regions, not speckles: where an image differs from the model beyond any chance.

Eq. 5 judges each pixel alone and so calls one in 370 different by chance. A change of the world
covers many pixels next to each other, so here the difference is averaged over a small window, the
standard deviation of that average is worked out from the noise and its correlation, and only
connected pixels that no noise would produce in a whole image are reported.
"""

import math
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy import ndimage, optimize
from torch import Tensor

from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.model.sensor import Sensor

FALSE_REGIONS_PER_IMAGE = 1e-2
"""Expected number of regions by chance; sigma' is seldom known well enough to claim less."""

FINEST_RESOLUTION = 5
"""Pixels: the edges of real depth cameras are wrong by one or two, and a window of five keeps such
a line from filling it, so a sensor with a narrow beam resolves no more than one with this beam."""

EDGE_TOLERANCE = 0.5
"""Pixels by which an edge or slope of the model may be displaced: optics and synthesis are not
known better, and on a slope of s metres a pixel that is a common error of half of s metres."""

OUTLIER = 8.0
"""Differences count as at most so many sigma' in the smallest window, so that a line of wild
pixels is no region; a window with more pixels bears more of each, up to ``OUTLIER_SHARE``."""

OUTLIER_SHARE = 0.25
"""In sigma': what one wild pixel may add to the average over a large window."""

SMALLEST_STEP = 0.5
"""In sigma': a smaller step may be real, but it is no larger than what the error model leaves out
(lens distortion, the roughness of surfaces), so it is not worth a change of the model."""

LARGEST_PATCH = 15
"""Pixels: the matching windows of depth cameras, and so the patches of their wild errors at edges
and on grazing surfaces, are no wider."""

HALF_MAXIMUM = 0.5
"""The average of a step over a window is half the step on its edge, so a region ends there."""

EVERY_NEIGHBOUR = np.ones((3, 3), bool)


class RegionKind(StrEnum):
    """How a region differs from the model."""

    NEARER = "nearer"
    FARTHER = "farther"
    UNMODELLED = "unmodelled"


@dataclass(frozen=True, kw_only=True, slots=True)
class Region:
    """Connected pixels that differ from the model in the same way."""

    kind: RegionKind
    mask: Bool[Tensor, "h w"]
    pixels: int
    significance: float
    """The largest local difference in its own sigmas; infinite where nothing is modelled."""
    bodies: dict[int, int]
    """Pixels for each body (index into ``Scene.bodies``) that the model shows there."""


@dataclass(frozen=True, kw_only=True, slots=True)
class LocalDifference:
    """The difference to the model, averaged over a window around every pixel, as arrays."""

    mean: Float[np.ndarray, "h w"]
    """In sigma'; positive where the measurement is farther; 0 where nothing was compared."""
    sigma: Float[np.ndarray, "h w"]
    """Standard deviation of ``mean`` if the model is right."""
    compared: Bool[np.ndarray, "h w"]


def connected_regions(mask: Bool[Tensor, "h w"]) -> Int[Tensor, "h w"]:
    """Numbers the 8-connected regions of a mask from 1; 0 outside the mask."""
    return torch.from_numpy(numbered(mask.cpu().numpy())).to(mask.device)


def numbered(mask: Bool[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """``connected_regions`` of an array."""
    labels = np.zeros(mask.shape, np.int64)
    ndimage.label(mask, structure=EVERY_NEIGHBOUR, output=labels)
    return labels


def resolution(beam: int) -> int:
    """Side (pixels) of the smallest thing that a sensor tells from its surroundings."""
    return max(beam, FINEST_RESOLUTION)


def window_side(beam: int) -> int:
    """Side (pixels, odd) of the averaging window.

    Half the beam: a wider window would blur the edges more than the beam has done already.
    """
    return max(beam // 2, FINEST_RESOLUTION) | 1


def least_pixels(beam: int, correlation_pixels: float) -> int:
    """The smallest region (pixels) worth a word.

    Half of what is resolved, which even a point fills when the beam smears it; where the range
    errors are correlated, the patch (one correlation length wide) of a single wild error.
    """
    patch = min(correlation_pixels, LARGEST_PATCH)
    return int(max(resolution(beam) ** 2 // 2, patch**2))


def significant_regions(
    comparison: FrameComparison, sensor: Sensor, *, correlation_pixels: float, alpha: float = 3.0
) -> tuple[Region, ...]:
    """The regions of one frame that differ from the model beyond chance.

    A region holds one pixel at least whose local difference would occur by chance in one of a
    hundred images, and around it the pixels beyond ``alpha`` of their own local standard deviation.

    Args:
        comparison: The frame; its sigma' contains every error, the slowly varying one as well.
        sensor: Its noise says which part of sigma' is independent from pixel to pixel.
        correlation_pixels: Correlation length (pixels) of the rest, 0 if it has none.
        alpha: The factor of eq. 1 and eq. 5.

    Returns:
        Nearer regions, then farther, then unmodelled ones, each the largest first.
    """
    local = local_difference(comparison, sensor)
    least = least_pixels(sensor.beam, correlation_pixels)
    # What is thinner than half of what is resolved, or a third of a patch, is an edge a little off.
    thickness = max(resolution(sensor.beam) // 2, math.isqrt(least) // 3) | 1
    window = window_side(sensor.beam)
    seed = chance_threshold(int(local.compared.sum()), window, correlation_pixels)
    body = comparison.body.cpu().numpy()
    found = []
    for kind, sign in ((RegionKind.NEARER, -1.0), (RegionKind.FARTHER, 1.0)):
        inside = (
            opened(_step(sign * local.mean, local, sensor.beam, alpha), thickness) & local.compared
        )
        score = np.where(inside, sign * local.mean / local.sigma, 0.0)
        found += [r for r in _regions(inside, kind, score, body, least) if r.significance > seed]
    unmodelled = (comparison.label == PixelClass.UNMODELLED) & comparison.usable
    inside = opened(unmodelled.cpu().numpy(), thickness)
    certain = np.full(inside.shape, math.inf)
    return (*found, *_regions(inside, RegionKind.UNMODELLED, certain, body, least))


def local_difference(comparison: FrameComparison, sensor: Sensor) -> LocalDifference:
    """The difference (measured - predicted)/sigma' averaged over the sensor's window.

    The independent part of sigma' averages out with the number of pixels. The rest (slowly varying
    range errors, errors of the estimated poses) does not within a window, and stays as it is.
    """
    measured, predicted, sigma = (
        image.double().cpu().numpy()
        for image in (comparison.measured, comparison.predicted, comparison.sigma)
    )
    compared = (
        comparison.usable.cpu().numpy()
        & (comparison.label != PixelClass.NOT_COMPARED).cpu().numpy()
    )
    compared = compared & np.isfinite(measured) & np.isfinite(predicted) & (sigma > 0.0)
    independent = np.minimum(sensor.noise.sigma(comparison.predicted).double().cpu().numpy(), sigma)
    window = window_side(sensor.beam)
    most = max(OUTLIER, OUTLIER_SHARE * window**2)
    with np.errstate(invalid="ignore"):
        total = np.hypot(sigma, EDGE_TOLERANCE * steepness(predicted))
        d = np.clip((measured - predicted) / total, -most, most)
        share = np.square(independent / total)
    mean, weight = box_mean(d, compared, window)
    share, _ = box_mean(share, compared, window)
    count = np.maximum(weight * window**2, 1.0)
    return LocalDifference(
        mean=np.where(compared, mean, 0.0),
        sigma=np.sqrt(share / count + np.maximum(1.0 - share, 0.0)),
        compared=compared,
    )


def box_mean(
    image: Float[np.ndarray, "h w"], mask: Bool[np.ndarray, "h w"], side: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """The mean of the masked pixels in a box, and which part of the box they fill."""
    weight = ndimage.uniform_filter(mask.astype(float), side, mode="constant")
    total = ndimage.uniform_filter(np.where(mask, image, 0.0), side, mode="constant")
    return total / np.maximum(weight, 0.5 / side**2), weight


def steepness(ranges: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """How much the range (m) changes from a pixel to the next; 0 towards pixels without a range."""
    steps = np.zeros((2, *ranges.shape))
    for axis in (0, 1):
        step = np.abs(np.nan_to_num(np.diff(ranges, axis=axis)))
        ahead = np.pad(step, [(0, int(axis == a)) for a in (0, 1)])
        behind = np.pad(step, [(int(axis == a), 0) for a in (0, 1)])
        steps[axis] = np.maximum(ahead, behind)
    return np.hypot(steps[0], steps[1])


def chance_threshold(compared: int, window: int, correlation_pixels: float) -> float:
    """The local difference (in its sigmas) that noise exceeds in one of a hundred images.

    Adler's expectation for the maxima of a smooth Gaussian field of correlation length L over an
    area A: A / L^2 (2 pi)^(-3/2) z exp(-z^2/2). White noise averaged over a box of side w has
    L^2 = w/2, from the correlation 1 - 1/w of neighbouring averages.
    """
    cells = max(compared, 1) / max(0.5 * window, correlation_pixels**2)
    both_signs = 2.0 * cells * (2.0 * math.pi) ** -1.5

    def excess(z: float) -> float:
        return math.log(both_signs * z) - 0.5 * z * z - math.log(FALSE_REGIONS_PER_IMAGE)

    # The formula holds for high levels only; fewer than three sigma are never significant.
    return optimize.root_scalar(excess, bracket=(3.0, 12.0)).root if excess(3.0) > 0.0 else 3.0


def opened(mask: Bool[np.ndarray, "h w"], side: int) -> Bool[np.ndarray, "h w"]:
    """The mask without the parts that a square of ``side`` pixels does not fit into."""
    padded = np.pad(mask, side, mode="edge")
    return ndimage.binary_opening(padded, np.ones((side, side), bool))[side:-side, side:-side]


def interior(mask: Bool[Tensor, "h w"], beam: int) -> Bool[Tensor, "h w"]:
    """The pixels farther than half a beam, and one for the edge, from the mask's silhouette."""
    square = np.ones((2 * (beam // 2) + 3,) * 2, bool)
    # What the image cuts off is no silhouette, hence the border counts as the mask's.
    pure = ndimage.binary_erosion(mask.cpu().numpy(), square, border_value=1)
    return torch.from_numpy(pure).to(mask.device)


def _step(
    signed: np.ndarray, local: LocalDifference, beam: int, alpha: float
) -> Bool[np.ndarray, "h w"]:
    """Where a step in one direction is, cut at half its height, with its small gaps closed."""
    inside = local.compared & (signed > alpha * local.sigma) & (signed > SMALLEST_STEP)
    # Beam and window smear a step so wide: half of that lies outside its edge, below half its
    # height. Only there, next to pixels that agree, is a small difference no part of the thing.
    smear = (beam + window_side(beam)) | 1
    rim = np.asarray(ndimage.maximum_filter(local.compared & ~inside, smear), bool)
    inside &= ~rim | (signed >= HALF_MAXIMUM * ndimage.maximum_filter(signed, smear))
    closed = ndimage.binary_closing(np.pad(inside, 2), EVERY_NEIGHBOUR, iterations=2)
    # Pixels without a measurement speak neither for nor against the region around them.
    return np.asarray(closed, bool)[2:-2, 2:-2] & ((signed > 0.0) | ~local.compared)


def _regions(
    inside: np.ndarray, kind: RegionKind, score: np.ndarray, body: np.ndarray, least: int
) -> list[Region]:
    """The connected regions of at least so many pixels, the largest first."""
    labels = numbered(inside)
    sizes = np.bincount(labels.ravel())
    large = [label for label in range(1, len(sizes)) if sizes[label] >= least]
    large.sort(key=lambda label: -sizes[label])
    return [_region(labels == label, kind, score, body) for label in large]


def _region(mask: np.ndarray, kind: RegionKind, score: np.ndarray, body: np.ndarray) -> Region:
    seen, counts = np.unique(body[mask], return_counts=True)
    return Region(
        kind=kind,
        mask=torch.from_numpy(mask),
        pixels=int(mask.sum()),
        significance=float(score[mask].max()),
        bodies={int(b): int(n) for b, n in zip(seen, counts, strict=True) if b >= 0},
    )
