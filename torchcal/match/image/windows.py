"""Planes fitted in all windows of a range image at once: 1/range = m . ray on a plane.

m is the plane's normal over its distance from the sensor, turned away from the sensor: m . p = 1 on
the plane. That holds for the rays of every projection.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn.functional import avg_pool2d

from torchcal.geometry.projection import pixel_grid
from torchcal.model.sensor import Sensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Image:
    """A range image with what every step needs of it: on the CPU, where elements are found."""

    range: Float[Tensor, "h w"]
    """m; 1 where nothing was measured."""
    valid: Bool[Tensor, "h w"]
    sigma: Float[Tensor, "h w"]
    """The standard deviation (m) of one pixel's noise."""
    rays: Float[Tensor, "h w 3"]
    """Of the middle of each pixel's beam, which is not the pixel's at the image's border."""
    sensor: Sensor


@dataclass(frozen=True, kw_only=True, slots=True)
class Windows:
    """The normal equations of the fit in each window of a grid."""

    information: Float[Tensor, "row column 3 3"]
    """The inverse covariance of m."""
    m: Float[Tensor, "row column 3"]
    chi2: Float[Tensor, "row column"]
    """Of the residuals, for each degree of freedom."""
    full: Bool[Tensor, "row column"]
    """Windows with enough measured pixels."""
    stride: int
    """Pixels from one window's first pixel to the next's."""
    side: int
    """Of a window, in pixels."""


FILLED = 0.5
"""The least share of a window's pixels that must be measured."""


def prepared(range_image: Tensor, sensor: Sensor, mask: Tensor | None) -> Image:
    """Rays and noise of all pixels; pixels without a measurement are marked."""
    range_image, mask = range_image.cpu(), None if mask is None else mask.cpu()
    measured = range_image.isfinite() & (range_image >= sensor.near) & (range_image <= sensor.far)
    valid = measured if mask is None else measured & mask
    image = torch.where(valid, range_image, 1.0).to(torch.float64)
    u, v = pixel_grid(sensor.projection, dtype=image.dtype, device=image.device)
    half = max(sensor.beam, 1) / 2
    h, w = image.shape
    return Image(
        range=image,
        valid=valid,
        sigma=sensor.noise.sigma(image),
        rays=sensor.projection.rays(_middle(u, half, w), _middle(v, half, h)),
        sensor=sensor,
    )


def _middle(place: Tensor, half: float, size: int) -> Tensor:
    """The middle of a beam that the image's border cuts (2.1: the mean over the part inside)."""
    return 0.5 * ((place - half).clamp(min=-0.5) + (place + half).clamp(max=size - 0.5))


def fit_windows(image: Image, *, side: int, stride: int) -> Windows:
    """Weighted least squares for m in the windows of ``side`` x ``side`` pixels.

    ``side`` is a multiple of ``stride``.
    """
    inverse = 1.0 / image.range
    weight = torch.where(image.valid, (image.range.square() / image.sigma).square(), 0.0)
    rays = image.rays.permute(2, 0, 1)
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    weighted = weight * rays
    layers = (
        *(weighted[i] * rays[j] for i, j in pairs),
        *(weighted * inverse),
        weight * inverse.square(),
        image.valid.to(weight.dtype),
    )
    sums = _window_sums(layers, side, stride)
    information = sums.new_empty(*sums.shape[1:], 3, 3)
    for k, (i, j) in enumerate(pairs):
        information[..., i, j] = information[..., j, i] = sums[k]
    return _solved(information, sums[6:9].permute(1, 2, 0), sums[9], sums[10], side, stride)


def _solved(
    information: Tensor, moment: Tensor, square: Tensor, count: Tensor, side: int, stride: int
) -> Windows:
    full = count >= FILLED * side * side
    safe = torch.where(
        full[..., None, None], information, torch.eye(3, dtype=moment.dtype, device=moment.device)
    )
    m = torch.linalg.solve_ex(safe, moment)[0]
    rest = square - (m * moment).sum(-1)
    return Windows(
        information=safe,
        m=m,
        chi2=torch.where(full, rest / (count - 3).clamp(min=1.0), torch.inf),
        full=full & m.isfinite().all(-1),
        stride=stride,
        side=side,
    )


def _window_sums(layers: Iterable[Float[Tensor, "h w"]], side: int, stride: int) -> Tensor:
    cells = torch.cat([avg_pool2d(each[None], stride, divisor_override=1) for each in layers])
    return avg_pool2d(cells, side // stride, stride=1, divisor_override=1)
