"""The borders of the planes of a mesh. Numpy, as the regions."""

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from torchcal.match.model.regions import Mesh, Regions

Borders = tuple[Float[ndarray, "_ 2 3"], ...]
"""The border segments (m) of each region, in the sense of its triangles and in no order."""


def find_borders(mesh: Mesh, regions: Regions) -> Borders:
    """Sides of triangles that another region or none continues; holes have them as well."""
    sides = mesh.faces[:, [[0, 1], [1, 2], [2, 0]]]
    owner = np.repeat(regions.of_face, 3)
    flat = sides.reshape(-1, 2)
    key = np.sort(flat, axis=1)
    count = len(mesh.vertices)
    number = (owner * count + key[:, 0]) * count + key[:, 1]
    _, where, times = np.unique(number, return_inverse=True, return_counts=True)
    single = times[where] == 1
    order = np.argsort(owner[single], kind="stable")
    segments = mesh.vertices[flat[single][order]]
    sizes = np.bincount(owner[single], minlength=len(regions.area))
    return tuple(np.split(segments, np.cumsum(sizes)[:-1]))


def outline(
    border: Float[ndarray, "segment 2 3"], normal: Float[ndarray, "3"]
) -> Float[ndarray, "corner 3"]:
    """The corners (m) of the outer border in order, anticlockwise about the normal.

    The loop that encloses most; holes are left out, and so are places where it goes straight on.
    """
    loops = [border[loop, 0] for loop in _loops(border)]
    if not loops:
        return np.zeros((0, 3))
    sizes = [_enclosed(loop, normal) for loop in loops]
    largest = loops[int(np.argmax(np.abs(sizes)))]
    before, after = largest - np.roll(largest, 1, 0), np.roll(largest, -1, 0) - largest
    bend = np.linalg.norm(np.cross(before, after), axis=1)
    size = np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1)
    return largest[bend > STRAIGHT * size]


STRAIGHT = 1e-3
"""Sine under which a border goes straight on."""


def _loops(border: Float[ndarray, "segment 2 3"]) -> list[Int[ndarray, " segment"]]:
    """Segments in the order in which each begins where the last ended."""
    start = {}
    for number, point in enumerate(border[:, 0]):
        start.setdefault(point.tobytes(), []).append(number)
    left, loops = set(range(len(border))), []
    while left:
        loop, number = [], min(left)
        while number in left:
            left.remove(number)
            loop.append(number)
            onward = [n for n in start.get(border[number, 1].tobytes(), []) if n in left]
            number = onward[0] if onward else -1
        loops.append(np.array(loop))
    return loops


def _enclosed(loop: Float[ndarray, "corner 3"], normal: Float[ndarray, "3"]) -> float:
    """The signed area (m^2)."""
    about = loop - loop.mean(0)
    return 0.5 * float(np.cross(about, np.roll(about, -1, 0)).sum(0) @ normal)
