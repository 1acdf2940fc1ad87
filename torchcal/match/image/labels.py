"""Which plane every pixel shows, and the planes fitted to the pixels that show nothing else."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage
from torch import Tensor

from torchcal.match.image.blocks import Blocks
from torchcal.match.image.growth import Regions
from torchcal.match.image.windows import Image, Windows

SMOOTHING = 5
"""Side in pixels of the mean that is compared with the planes, at the least."""
NEAR_PLANE = 6.0
"""Standard deviations of the mean that a pixel may be off the plane it shows."""
SURE = 2.0
"""Standard deviations of chi-square that are no accident."""
SMALLEST = 100
"""Pixels that must show a plane alone."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Planar:
    """Planes in a range image with the pixels that show them."""

    label: Int[ndarray, "h w"]
    """The plane of each pixel; -1 for none."""
    pure: Bool[ndarray, "h w"]
    """Pixels whose beam meets nothing but the plane of their label."""
    m: Float[Tensor, "plane 3"]
    covariance: Float[Tensor, "plane 3 3"]
    """Of m."""
    chi2: Float[Tensor, " plane"]
    """Of the residuals, for each degree of freedom."""
    excess: float
    """Variance of the planes' windows in units of what the noise explains."""


def label_pixels(
    image: Image,
    blocks: Blocks,
    clear: Bool[ndarray, "h w"],
    windows: Windows,
    regions: Regions,
) -> Planar:
    """Extends regions from windows to pixels and fits their planes to what is not blurred."""
    half = max(image.sensor.beam, 1) // 2
    reach = half + windows.side // 2 + windows.stride
    label = _nearest(image, windows, regions, reach)
    pure = _pure(label, clear, half)
    alone = blocks.of(np.where(pure, label, -1))
    size = np.bincount(alone[alone >= 0], minlength=len(regions.m)) * blocks.side**2
    if (size < SMALLEST).any():
        regions = regions.only(size >= SMALLEST)
        label = _nearest(image, windows, regions, reach)
        pure = _pure(label, clear, half)
        alone = blocks.of(np.where(pure, label, -1))
    m, covariance, chi2 = refit(blocks, alone, regions.m)
    return Planar(
        label=label, pure=pure, m=m, covariance=covariance, chi2=chi2, excess=regions.excess
    )


def _nearest(image: Image, windows: Windows, regions: Regions, reach: int) -> ndarray:
    """The plane nearest to the smoothed image, among those whose cores are within reach."""
    valid = image.valid.numpy()
    mean, side = smooth(image, SMOOTHING)
    limit = NEAR_PLANE * np.sqrt(regions.excess) / side * image.sigma.numpy()
    rays = image.rays.numpy()
    blur = 2 * max(image.sensor.beam // 2, 1) + 1
    best = np.full(valid.shape, np.inf, np.float32)
    label = np.full(valid.shape, -1)
    for index, place in enumerate(ndimage.find_objects(regions.label + 1)):
        box, close = _within(regions.label[place] == index, place, windows, reach, valid.shape)
        off = np.abs(mean[box] * (rays[box] @ regions.m[index]) - 1.0) * mean[box]
        seen = ndimage.maximum_filter((off < limit[box]) & close, blur)
        nearer = close & seen & valid[box] & (off < best[box])
        best[box][nearer] = off[nearer]
        label[box][nearer] = index
    return label


def smooth(image: Image, least: int) -> tuple[Float[ndarray, "h w"], int]:
    """The mean over the valid pixels of a square that blurs less than the beam, and its side."""
    valid = image.valid.numpy()
    side = max(least, image.sensor.beam // 4 * 2 + 1)
    share = ndimage.uniform_filter(valid.astype(float), side)
    ranges = np.where(valid, image.range.numpy(), 0.0)
    return ndimage.uniform_filter(ranges, side) / np.maximum(share, 1e-9), side


def _within(
    members: Bool[ndarray, "row column"], place: tuple, windows: Windows, reach: int, shape: tuple
) -> tuple[tuple[slice, slice], Bool[ndarray, "h w"]]:
    """A cut-out of the image, and its pixels within reach of some windows (to a window's step)."""
    step = windows.stride
    more = -(-reach // step)
    wide = ndimage.maximum_filter(np.pad(members, more), 2 * more + 1)
    fine = np.repeat(np.repeat(wide, step, 0), step, 1)
    middle = (windows.side - step) // 2
    first = [(part.start - more) * step + middle for part in place]
    low = [max(start, 0) for start in first]
    cut = tuple(
        slice(a - start, size - start) for a, start, size in zip(low, first, shape, strict=True)
    )
    fine = fine[cut]
    rows, columns = (slice(a, a + size) for a, size in zip(low, fine.shape, strict=True))
    return (rows, columns), fine


def _pure(label: ndarray, valid: ndarray, half: int) -> ndarray:
    """Pixels with one label all over their beam."""
    side = 2 * half + 3
    low = np.asarray(ndimage.minimum_filter(label, side))
    high = np.asarray(ndimage.maximum_filter(label, side))
    return (low == high) & (label >= 0) & valid


def refit(
    blocks: Blocks, label: Int[ndarray, "h w"], m: Float[ndarray, "plane 3"]
) -> tuple[Tensor, Tensor, Tensor]:
    """Gauss-Newton on the ranges, with the curvature that the beam's mean sees (eq. 18).

    Returns:
        m, its covariance and the chi-square of the residuals for each degree of freedom.
    """
    count = len(m)
    rows, columns = np.nonzero((label >= 0) & blocks.valid)
    used = rows, columns
    plane = torch.from_numpy(label[used])
    rays, ranges, sigma = (
        torch.from_numpy(each[used]) for each in (blocks.rays, blocks.range, blocks.sigma)
    )
    spread = _spread(blocks, used)
    size = torch.bincount(plane, minlength=count)

    def linearised(estimate: Tensor) -> tuple[Tensor, Tensor]:
        own = estimate[plane]
        inverse = (own * rays).sum(-1)
        bend = 1.0 + (spread @ own[..., None]).squeeze(-1).square().sum(-1) / inverse.square()
        jacobian = -rays * (bend / (sigma * inverse.square()))[:, None]
        return (ranges - bend / inverse) / sigma, jacobian

    estimate = torch.as_tensor(m, dtype=ranges.dtype)
    for _ in range(2):
        residual, jacobian = linearised(estimate)
        information, moment = _sums(plane, jacobian, residual, count)
        estimate = estimate + torch.linalg.solve_ex(information, moment)[0]
    residual, jacobian = linearised(estimate)
    information, _ = _sums(plane, jacobian, residual, count)
    squares = torch.bincount(plane, residual.square(), minlength=count).to(ranges)
    chi2 = squares / torch.clamp(size - 3, min=1)
    covariance = torch.linalg.pinv(information, hermitian=True)
    return estimate, covariance * systematic(chi2, size, 3)[:, None, None], chi2


def systematic(chi2: Tensor, count: Tensor, unknowns: int) -> Tensor:
    """By what residuals that noise does not explain make a fit's covariance larger.

    What is left over of chi-square is taken for an error with one sign all over the pixels.
    """
    surplus = chi2 - 1.0 - SURE * (2.0 / count.clamp(min=1)).sqrt()
    return 1.0 + surplus.clamp(min=0.0) * count / unknowns


def _spread(blocks: Blocks, used: tuple[ndarray, ndarray]) -> Float[Tensor, "block 2 3"]:
    """The standard deviations of the beam, as changes of the ray to the right and down."""
    return torch.from_numpy(blocks.slopes(*used) * (blocks.beam / 12**0.5))


def _sums(plane: Tensor, jacobian: Tensor, residual: Tensor, count: int) -> tuple[Tensor, Tensor]:
    information = jacobian.new_zeros(count, 3, 3)
    for i in range(3):
        for j in range(i, 3):
            total = torch.bincount(plane, jacobian[:, i] * jacobian[:, j], minlength=count)
            information[:, i, j] = information[:, j, i] = total
    moment = [torch.bincount(plane, jacobian[:, i] * residual, minlength=count) for i in range(3)]
    return information, torch.stack(moment, -1).to(information)
