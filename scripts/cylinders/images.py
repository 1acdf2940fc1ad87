"""Points as a range image: what a pinhole camera sees of the surface through them."""

import numpy as np
from scipy.spatial import Delaunay

LONGEST = 4.0
"""Pixels: triangles with longer sides bridge gaps."""


def range_image(
    points: np.ndarray,
    side: np.ndarray,
    *,
    focal: float,
    centre: np.ndarray,
    shape: tuple[int, int],
) -> tuple[np.ndarray, np.ndarray]:
    """Depth and mask, linear in inverse depth between neighbouring points, as planes are.

    Args:
        points: (point 3), m, in the camera's frame.
        side: Which of them the mask is to show.
        focal: Pixels.
        centre: Of the image: column and row of the ray (0, 0, 1).
        shape: Rows and columns.

    Returns:
        Depth (m), NaN where nothing was seen; the mask, true where the side was.
    """
    places = focal * points[:, :2] / points[:, 2:] + centre
    mesh = Delaunay(places)
    rows, columns = np.indices(shape)
    pixels = np.stack([columns.ravel(), rows.ravel()], 1).astype(float)
    triangle = mesh.find_simplex(pixels)
    corners = mesh.simplices[triangle]
    # Delaunay keeps for each triangle the map to the barycentric coordinates of its first corners.
    maps = mesh.transform[triangle]
    first = np.einsum("pij,pj->pi", maps[:, :2], pixels - maps[:, 2])
    weight = np.concatenate([first, 1.0 - first.sum(1, keepdims=True)], 1)
    inverse = (weight / points[corners, 2]).sum(1)
    sides = np.linalg.norm(places[corners] - places[np.roll(corners, 1, 1)], axis=2)
    seen = (triangle >= 0) & (sides.max(1) < LONGEST)
    depth = np.where(seen, 1.0 / np.where(seen, inverse, 1.0), np.nan)
    return depth.reshape(shape), (seen & side[corners].all(1)).reshape(shape)
