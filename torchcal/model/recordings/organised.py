"""Organised clouds: which sensor's image they are."""

import numpy as np
from numpy.typing import NDArray

from torchcal.geometry.projection import Pinhole, Spherical
from torchcal.model.recordings.layout import (
    BODY,
    OPTICAL,
    Layout,
    Points,
    angles,
    centred,
    measured,
)

_FITS = 0.25
"""Pixels that nearly all points may lie beside their pixel."""
_NEARLY_ALL = 0.98


def organised_layout(points: Points) -> Layout | None:
    """The pinhole or the spherical sensor whose pixels an organised cloud ``(h w 3)`` shows."""
    for axes in (OPTICAL, BODY):
        hole = _pinhole(points @ axes)
        if hole is not None:
            return Layout(projection=hole, R_cloud_sensor=axes)
    for axes in (BODY, OPTICAL):
        found = _spherical(points @ axes)
        if found is not None:
            return Layout(projection=found[0], R_cloud_sensor=axes, flipped=found[1])
    return None


def _pinhole(points: Points) -> Pinhole | None:
    height, width = points.shape[:2]
    seen = measured(points)
    x, y, z = points[seen].T
    if len(z) < 3 or height < 2 or width < 2 or (z <= 0.0).any():
        return None
    v, u = (index.astype(float) for index in np.nonzero(seen))
    (fx, cx), (fy, cy) = (_line(over / z, pixel) for over, pixel in ((x, u), (y, v)))
    if not (fx > 0.0 and fy > 0.0):
        return None
    away = np.maximum(np.abs(fx * x / z + cx - u), np.abs(fy * y / z + cy - v))
    if np.quantile(away, _NEARLY_ALL) > _FITS:
        return None
    return Pinhole(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _spherical(points: Points) -> tuple[Spherical, tuple[int, ...]] | None:
    height, width = points.shape[:2]
    seen = measured(points)
    if height < 2 or width < 2 or seen.sum() < 3:
        return None
    azimuth, elevation = (np.where(seen, angle, np.nan) for angle in angles(points))
    v, u = np.nonzero(seen)
    across, up = _azimuths(azimuth, u), _line(v.astype(float), elevation[seen])
    if across[0] == 0.0 or up[0] == 0.0:
        return None
    turned = np.remainder(azimuth[seen] - across[0] * u - across[1] + np.pi, 2 * np.pi) - np.pi
    beside = np.abs(turned / across[0]), np.abs((elevation[seen] - up[0] * v - up[1]) / up[0])
    if np.quantile(np.maximum(*beside), _NEARLY_ALL) > _FITS:
        return None
    az = [across[1], across[1] + (width - 1) * across[0]]
    el = [up[1], up[1] + (height - 1) * up[0]]
    flipped = ((0,) if up[0] > 0.0 else ()) + ((1,) if across[0] < 0.0 else ())
    first, last = max(el), min(el)
    azimuths = centred(min(az), max(az))
    return Spherical(width=width, height=height, azimuth=azimuths, elevation=(first, last)), flipped


def _azimuths(azimuth: Points, u: NDArray[np.int64]) -> tuple[float, float]:
    """Slope and first of the columns' azimuths (rad), which may run through a whole turn."""
    columns = np.unique(u)
    turns = np.exp(1j * azimuth[:, columns])
    angles = np.unwrap(np.angle(np.nansum(turns, 0)))
    return _line(columns.astype(float), angles)


def _line(x: Points, y: Points) -> tuple[float, float]:
    """Slope and height at 0 of the straight line through points, the worst tenth left out."""
    A = np.stack([x, np.ones_like(x)], 1)
    (slope, height), *_ = np.linalg.lstsq(A, y, rcond=None)
    away = np.abs(slope * x + height - y)
    kept = away <= np.quantile(away, 0.9)
    (slope, height), *_ = np.linalg.lstsq(A[kept], y[kept], rcond=None)
    return float(slope), float(height)
