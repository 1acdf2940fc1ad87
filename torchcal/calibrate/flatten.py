"""Planes stay flat: measured ranges of a flat side are put onto its plane (section 2.5).

A plane is m . p = 1. With p = z ray the residual m . p - 1 is the error of the range z over z.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy import ndimage

from torchcal.calibrate.regions import EVERY_NEIGHBOUR, numbered

LEAST_SHARE = 0.05
"""Of a region's pixels: a smaller side is not worth a plane."""
LEAST_PIXELS = 40
"""A plane through fewer says nothing about flatness."""
SEEDS, SEED_SIDE = 40, 9
"""Windows that are tried for the next plane, and their side (pixels)."""
WITHIN = 3.0
"""Standard deviations within which a pixel may lie on a plane."""
WILD = 6.0
"""The same for one that others on the plane surround."""
FLAT = 1.25
"""Largest spread about a plane, in standard deviations of the noise: more is a bend."""
MOST = 12
"""Planes of one region."""


def flattened(
    ranges: Float[np.ndarray, "h w"],
    inside: Bool[np.ndarray, "h w"],
    rays: Float[np.ndarray, "h w 3"],
    sigma: float,
) -> Float[np.ndarray, "h w"]:
    """The ranges (m) with every flat side on its plane.

    Args:
        ranges: m; finite inside.
        inside: The region.
        rays: Of the pixels.
        sigma: Standard deviation (m) of ``ranges``.
    """
    result, left = ranges.copy(), inside & (ranges > 0.0)
    least = max(LEAST_PIXELS, LEAST_SHARE * left.sum())
    points = np.where(left, ranges, 0.0)[..., None] * rays
    for _ in range(MOST):
        plane = _largest_plane(points, ranges, left, sigma)
        if plane is None:
            break
        on = _largest_part(left & (_off(plane, points, ranges) <= WITHIN * sigma))
        if on.sum() < least:
            break
        m = _fitted(points[on], ranges[on])
        around = np.asarray(ndimage.binary_closing(on, EVERY_NEIGHBOUR), bool)
        on = left & around & (_off(m, points, ranges) <= WILD * sigma)
        if not on.any():
            break
        if np.sqrt(np.mean(_off(m, points[on], ranges[on]) ** 2)) <= FLAT * sigma:
            result[on] = 1.0 / (rays[on] @ m)
        left = left & ~on
    return result


def _largest_plane(
    points: Float[np.ndarray, "h w 3"],
    ranges: Float[np.ndarray, "h w"],
    left: Bool[np.ndarray, "h w"],
    sigma: float,
) -> Float[np.ndarray, "3"] | None:
    """Of the planes through small windows the one on which most pixels lie."""
    rows, columns = np.nonzero(left)
    if len(rows) < LEAST_PIXELS:
        return None
    half, best, most = SEED_SIDE // 2, None, 0
    for k in np.linspace(0, len(rows) - 1, SEEDS).astype(int):
        window = (
            slice(max(rows[k] - half, 0), rows[k] + half + 1),
            slice(max(columns[k] - half, 0), columns[k] + half + 1),
        )
        own = left[window]
        m = _fitted(points[window][own], ranges[window][own])
        on = left & (_off(m, points, ranges) <= WITHIN * sigma)
        if on.sum() > most:
            # Once more with all of them: a small window leaves the slopes open.
            best, most = _fitted(points[on], ranges[on]), on.sum()
    return best


def _fitted(
    points: Float[np.ndarray, "point 3"], ranges: Float[np.ndarray, " point"]
) -> Float[np.ndarray, "3"]:
    """Least squares in the ranges; the shortest m where the points leave it open."""
    return np.linalg.lstsq(points * ranges[:, None], ranges, rcond=1e-9)[0]


def _off(
    m: Float[np.ndarray, "3"],
    points: Float[np.ndarray, "*pixel 3"],
    ranges: Float[np.ndarray, "*pixel"],
) -> Float[np.ndarray, "*pixel"]:
    """How far (m) measured ranges are from a plane."""
    return np.abs(points @ m - 1.0) * ranges


def _largest_part(mask: Bool[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """The largest connected part of a mask."""
    labels = numbered(mask)
    sizes = np.bincount(labels[mask].ravel())
    return labels == sizes.argmax() if len(sizes) else mask
