"""Clouds whose points stand in no order: projected onto a spherical sensor."""

import math
from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import KDTree

from torchcal.geometry.projection import Spherical
from torchcal.model.recordings.layout import BODY, OPTICAL, Layout, Points, angles, measured

_MOST_PIXELS = 4_000_000
_SAMPLED = 20_000
"""So many points tell how far apart they are."""
_SMOOTH = 0.02
"""Neighbours whose inverse ranges bend by less than this share lie on one surface."""


def projected_layout(clouds: Iterable[Points], resolution: float) -> Layout:
    """The smallest spherical sensor with square pixels that sees all points of all clouds.

    Points that all lie before a sensor that looks along z were taken by one that does; others are
    in the axes that ROS gives to a body.

    Args:
        clouds: Points ``(point 3)`` in any order, in the sensor's own frame.
        resolution: Of its pixels (rad).

    Raises:
        ValueError: If it had more than four million pixels, or there are no points.
    """
    seen = [points[measured(points)] for points in clouds]
    seen = [_extent(points) for points in seen if len(points)]
    if not seen:
        raise ValueError("no points")
    if all(in_front for in_front, _, _ in seen):
        return _layout(np.stack([as_optical for _, as_optical, _ in seen]), OPTICAL, resolution)
    return _layout(np.stack([as_body for _, _, as_body in seen]), BODY, resolution)


def _extent(points: Points) -> tuple[bool, Points, Points]:
    """Whether all points lie in front along z; their extreme angles in both kinds of axes."""
    extremes = [
        np.array([[angle.min(), angle.max()] for angle in angles(points @ axes)])
        for axes in (OPTICAL, BODY)
    ]
    return bool((points[:, 2] > 0.0).all()), extremes[0], extremes[1]


def _layout(extents: Points, axes: Points, resolution: float) -> Layout:
    """A sensor that sees all of some angles ``(cloud 2 2)``."""
    low, high = extents[..., 0].min(0), extents[..., 1].max(0)
    first, last = np.floor(low / resolution), np.ceil(high / resolution)
    columns, rows = (int(count) for count in last - first + 1)
    columns = min(columns, math.floor(2.0 * math.pi / resolution))
    if columns * rows > _MOST_PIXELS:
        words = f"{columns}x{rows} pixels at a resolution of {math.degrees(resolution):.3g} degrees"
        raise ValueError(f"{words}; expected at most {_MOST_PIXELS}: a larger --resolution")
    az, el = float(first[0]) * resolution, float(last[1]) * resolution
    projection = Spherical(
        width=columns,
        height=rows,
        azimuth=(az, az + (columns - 1) * resolution),
        elevation=(el, el - (rows - 1) * resolution),
    )
    return Layout(projection=projection, R_cloud_sensor=axes)


def own_resolution(points: Points) -> float:
    """1.5 times the angle (rad) from a point to its neighbour: few pixels stay empty."""
    rays = points[measured(points)]
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    some = rays[:: max(1, len(rays) // _SAMPLED)]
    away, _ = KDTree(rays).query(some, k=2)
    return 1.5 * float(np.median(away[:, 1]))


def projected_image(points: Points, layout: Layout) -> NDArray[np.float32]:
    """The image (m) of points ``(point 3)``: each pixel holds the one nearest to its middle.

    Where its neighbours lie on the same surface, the range is moved along it to the middle.
    """
    seen = torch.from_numpy(points[measured(points)] @ layout.R_cloud_sensor)
    uv, ranges = (
        part(seen).numpy() for part in (layout.projection.pixels, layout.projection.ranges)
    )
    cells = np.rint(uv).astype(int)
    size = layout.projection.width, layout.projection.height
    inside = ((cells >= 0) & (cells < size)).all(1)
    cells, beside, ranges = cells[inside], (uv - cells)[inside], ranges[inside]
    order = np.argsort(-np.abs(beside).max(1), kind="stable")
    image = np.full((3, size[1], size[0]), np.nan)
    values = np.stack([1.0 / ranges, *beside.T])
    image[:, cells[order, 1], cells[order, 0]] = values[:, order]
    inverse, across, down = image
    moved = inverse - _step(inverse, across, 1) * across - _step(inverse, down, 0) * down
    return (1.0 / moved).astype(np.float32)


def _step(inverse: Points, beside: Points, axis: int) -> Points:
    """How the inverse range, which is linear on a plane, changes from pixel to pixel; 0: a jump."""
    change = np.zeros_like(inverse)
    before, middle, after = (_part(inverse, axis, k) for k in range(3))
    apart = 2.0 + _part(beside, axis, 2) - _part(beside, axis, 0)
    smooth = np.abs(before - 2.0 * middle + after) < _SMOOTH * middle
    smooth &= apart > 1.0
    np.copyto(_part(change, axis, 1), (after - before) / apart, where=smooth)
    return change


def _part(image: Points, axis: int, start: int) -> Points:
    """All but two rows (0) or columns (1), from one of the first three on."""
    stop = image.shape[axis] - 2 + start
    return image[start:stop] if axis == 0 else image[:, start:stop]
