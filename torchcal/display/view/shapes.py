"""What stands in the three-dimensional view, as plain arrays: points, frustum, ellipsoid."""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.display.arrays import as_array
from torchcal.display.colours import class_image, range_image, range_limits
from torchcal.geometry.projection import Projection, pixel_grid

MOST_POINTS = 60_000
"""More do not show more, and take a browser without a GPU seconds."""

BORDER_STEPS = 8
"""Pieces of each side of a frustum's border: that of a spherical sensor is curved."""

SIGMAS = 3.0
"""The ellipsoid's size, in standard deviations along its axes."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Points:
    """A coloured cloud of points."""

    positions: Float[np.ndarray, "point 3"]
    """m, in the sensor's frame."""
    colours: UInt8[np.ndarray, "point 3"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Ellipsoid:
    """Where a position may be."""

    radii: Float[np.ndarray, " 3"]
    """m, the longest first: ``SIGMAS`` standard deviations."""
    R_sensor_ellipsoid: Float[np.ndarray, "3 3"]
    """Its axes are the columns."""


def class_points(comparison: FrameComparison, projection: Projection) -> Points:
    """Every compared pixel in the colour of its class.

    It stands where it was measured, and where the model has it if nothing was measured.
    """
    label = as_array(comparison.label)
    missing = label == PixelClass.MISSING
    ranges = np.where(missing, as_array(comparison.predicted), as_array(comparison.measured))
    shown = (label != PixelClass.NOT_COMPARED) & np.isfinite(ranges)
    return _points(ranges, shown, class_image(label), projection)


def range_points(comparison: FrameComparison, projection: Projection) -> Points:
    """Every measured pixel by its range, whatever the model says: the raw measurement."""
    ranges = as_array(comparison.measured)
    colours = range_image(ranges, range_limits(ranges))
    return _points(ranges, np.isfinite(ranges), colours, projection)


def frustum(projection: Projection, length: float) -> Float[np.ndarray, "segment 2 3"]:
    """The sensor's field of view as lines in its frame, from it to a range of ``length`` (m)."""
    right, below = projection.width - 0.5, projection.height - 0.5
    corners = [(-0.5, -0.5), (right, -0.5), (right, below), (-0.5, below)]
    share = np.arange(BORDER_STEPS)[:, None] / BORDER_STEPS
    ends = [*corners[1:], corners[0]]
    border = np.concatenate(
        [(1 - share) * start + share * end for start, end in _pairs(corners, ends)]
    )
    pixels = torch.from_numpy(border)
    rim = length * projection.rays(pixels[:, 0], pixels[:, 1]).numpy()
    edges = np.stack([np.zeros((4, 3)), rim[::BORDER_STEPS]], axis=1)
    return np.concatenate([edges, np.stack([rim, np.roll(rim, -1, axis=0)], axis=1)])


def ellipsoid(pose_covariance: Float[Tensor, "6 6"]) -> Ellipsoid:
    """The position part of the covariance of a twist on the right of ``T_world_sensor``."""
    P = np.nan_to_num(as_array(pose_covariance)[:3, :3].astype(float))
    variances, axes = np.linalg.eigh(0.5 * (P + P.T))
    order = [2, 1, 0]
    axes = axes[:, order]
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    radii = SIGMAS * np.sqrt(np.clip(variances[order], 0.0, None))
    return Ellipsoid(radii=radii, R_sensor_ellipsoid=axes)


def _pairs(
    starts: list[tuple[float, float]], ends: list[tuple[float, float]]
) -> list[tuple[np.ndarray, np.ndarray]]:
    return [(np.array(a), np.array(b)) for a, b in zip(starts, ends, strict=True)]


def _points(
    ranges: Float[np.ndarray, "h w"],
    shown: Bool[np.ndarray, "h w"],
    colours: UInt8[np.ndarray, "h w 3"],
    projection: Projection,
) -> Points:
    """The shown pixels as points, every few of them where there are too many."""
    step = max(1, math.ceil(math.sqrt(shown.sum() / MOST_POINTS)))
    few = np.zeros_like(shown)
    few[::step, ::step] = True
    v, u = np.nonzero(shown & few)
    grid = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    rays = projection.rays(*(axis[v, u] for axis in grid)).numpy()
    positions = rays * ranges[v, u][:, None].astype(float)
    return Points(positions=positions, colours=colours[v, u])
