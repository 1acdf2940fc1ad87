"""A cylinder in a point cloud: its flat end, its side, its radius."""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

TRIALS = 500
"""Planes through three points that are looked at for the end."""
FLAT = 0.0005
"""m: points of the end lie so near to its plane."""
SCALE = 0.0003
"""m: residuals of the side beyond this count less."""


@dataclass(frozen=True, kw_only=True)
class Cylinder:
    """A cylinder as one view shows it, in the camera's frame."""

    centre: np.ndarray
    """A point of the axis, amid what was seen of the side (m)."""
    axis: np.ndarray
    """Unit vector, out of the end that was seen."""
    radius: float
    """m"""
    noise: float
    """Robust standard deviation of the points about the side (m)."""
    side: np.ndarray
    """(point), bool: which points show the side and not the end."""


def find_cylinder(points: np.ndarray, *, margin: float, rng: np.random.Generator) -> Cylinder:
    """The end is the plane with the most points; what lies below it is the side.

    Args:
        points: (point 3), in the camera's frame (m).
        margin: Points of the side are at least so far (m) below the plane of the end.
        rng: Draws the planes.
    """
    middle, normal = _end(points, rng)
    side = (points - middle) @ normal < -margin
    across = np.linalg.svd(normal[None])[2][1:]

    def line(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        axis = normal + x[:2] @ across
        return middle + x[2:4] @ across, axis / np.linalg.norm(axis)

    def residuals(x: np.ndarray) -> np.ndarray:
        point, axis = line(x)
        offset = points[side] - point
        return np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=1) - x[4]

    start = [0.0, 0.0, 0.0, 0.0, 0.5 * float(np.ptp(points[~side], axis=0).max())]
    fit = least_squares(residuals, start, loss="soft_l1", f_scale=SCALE)
    point, axis = line(fit.x)
    return Cylinder(
        centre=point + np.median((points[side] - point) @ axis) * axis,
        axis=axis,
        radius=float(fit.x[4]),
        noise=float(1.4826 * np.median(np.abs(residuals(fit.x)))),
        side=side,
    )


def _end(points: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A point of the plane and its normal, towards the camera."""
    corners = points[rng.integers(len(points), size=(TRIALS, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-12)
    near = np.abs(points @ normals.T - (corners[:, 0] * normals).sum(1)) < FLAT
    plane = points[near[:, near.sum(0).argmax()]]
    middle = plane.mean(0)
    normal = np.linalg.svd(plane - middle, full_matrices=False)[2][2]
    return middle, -np.sign(normal @ middle) * normal
