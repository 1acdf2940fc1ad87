"""Where surfaces meet that share no edge: a crate on the floor shows a concave line at its foot.

Two planes show one along the part of their common line at which both go on before the other: no
edge of a mesh is needed, and parts of one body that were put together count as well.
"""

from itertools import pairwise

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray

from torchcal.match.features import LineKind
from torchcal.match.model.edges import Segments
from torchcal.match.model.outlines import Borders
from torchcal.match.model.regions import Regions
from torchcal.match.model.tolerances import Tolerances


def find_contacts(
    regions: Regions,
    borders: Borders,
    known: Int[ndarray, "known 2"],
    tolerances: Tolerances,
    gap: float,
) -> Segments:
    """The lines at which planes meet without an edge of the mesh.

    Args:
        regions: In one frame.
        borders: Of the regions.
        known: Pairs of regions that share an edge.
        tolerances: The least angle and the least length.
        gap: How far (m) a surface may end before the other; planes that go on for less are not
            seen beside each other.
    """
    pairs = _near_pairs(regions, borders, known, tolerances, gap)
    found = [(pair, piece) for pair in pairs for piece in _meetings(regions, borders, pair, gap)]
    kept = [
        (pair, piece)
        for pair, piece in found
        if np.linalg.norm(piece[1] - piece[0]) >= tolerances.least_length
    ]
    count = len(kept)
    beside = np.array([pair for pair, _ in kept], np.int64).reshape(count, 2)
    a, b = regions.normal[beside[:, 0]], regions.normal[beside[:, 1]]
    return Segments(
        ends=np.array([piece for _, piece in kept]).reshape(count, 2, 3),
        is_end=np.zeros((count, 2), bool),
        kind=np.full(count, LineKind.CONCAVE.value),
        dihedral=np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), (a * b).sum(1)),
        regions=beside,
    )


def _near_pairs(
    regions: Regions,
    borders: Borders,
    known: Int[ndarray, "known 2"],
    tolerances: Tolerances,
    gap: float,
) -> Int[ndarray, "pair 2"]:
    """Planes at an angle, with boxes that overlap, each with parts before the other."""
    planes = np.flatnonzero(regions.is_plane)
    points = [borders[region].reshape(-1, 3) for region in planes]
    if len(planes) < 2:
        return np.zeros((0, 2), np.int64)
    low = np.array([p.min(0) for p in points]) - gap
    high = np.array([p.max(0) for p in points]) + gap
    normal, point = regions.normal[planes], regions.point[planes]
    cosine = normal @ normal.T
    near = np.abs(cosine) < np.cos(tolerances.crease)
    near &= (low[:, None] <= high).all(2) & (low <= high[:, None]).all(2)
    lowest, highest = _heights(points, normal, point)
    straddles = (highest > gap) & (lowest < gap)
    near &= straddles & straddles.T
    one, two = np.nonzero(np.triu(near, 1))
    pairs = planes[np.stack([one, two], 1)]
    size = len(regions.area)
    ordered = np.sort(pairs, axis=1) @ (size, 1)
    return pairs[~np.isin(ordered, np.sort(known, axis=1) @ (size, 1))]


def _heights(points: list[ndarray], normal: ndarray, point: ndarray) -> tuple[ndarray, ndarray]:
    """The lowest and the highest point of each outline (row) above each plane (column)."""
    starts = np.cumsum([0, *(len(p) for p in points[:-1])])
    height = np.concatenate(points) @ normal.T - (normal * point).sum(1)
    return np.minimum.reduceat(height, starts), np.maximum.reduceat(height, starts)


def _meetings(
    regions: Regions, borders: Borders, pair: ndarray, gap: float
) -> list[Float[ndarray, "2 3"]]:
    """The pieces of the common line at which both planes go on before the other."""
    (n_a, n_b), (p_a, p_b) = regions.normal[pair], regions.point[pair]
    along = np.cross(n_a, n_b)
    along = along / np.linalg.norm(along)
    origin = np.linalg.solve(
        np.stack([n_a, n_b, along]), np.array([n_a @ p_a, n_b @ p_b, along @ p_a])
    )
    inside = [
        _intervals(borders[region], origin, along, np.cross(along, own), other, gap)
        for region, own, other in zip(pair, (n_a, n_b), (n_b, n_a), strict=True)
    ]
    return [
        np.stack([origin + max(a[0], b[0]) * along, origin + min(a[1], b[1]) * along])
        for a in inside[0]
        for b in inside[1]
        if min(a[1], b[1]) > max(a[0], b[0])
    ]


def _intervals(
    border: ndarray, origin: ndarray, along: ndarray, across: ndarray, other: ndarray, gap: float
) -> list[tuple[float, float]]:
    """Where a plane's area covers a parallel of a line, on the side before another plane."""
    across = across if across @ other > 0.0 else -across
    height = (border - origin) @ across - gap
    place = (border - origin) @ along
    cut = (height[:, 0] > 0.0) != (height[:, 1] > 0.0)
    height, place = height[cut], place[cut]
    share = height[:, 0] / (height[:, 0] - height[:, 1])
    crossings = np.sort(place[:, 0] + share * (place[:, 1] - place[:, 0]))
    return _joined([(a, b) for a, b in list(pairwise(crossings))[::2] if b > a])


def _joined(intervals: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """Intervals that touch are one."""
    joined: list[tuple[float, float]] = []
    for start, end in intervals:
        if joined and start <= joined[-1][1] + 1e-9:
            joined[-1] = joined[-1][0], end
        else:
            joined.append((start, end))
    return joined


def without_buried(segments: Segments, contacts: Segments, reach: float) -> Segments:
    """Edges without those along a contact of one of their planes: what is seen there is concave.

    Args:
        segments: Edges of the meshes.
        contacts: Where surfaces meet.
        reach: How far (m) an edge may be from the contact.
    """
    if not len(contacts.kind) or not len(segments.kind):
        return segments
    start, along = contacts.ends[:, 0], contacts.direction
    offset = segments.ends[:, None] - start[None, :, None]
    place = np.einsum("lcek,ck->lce", offset, along)
    across = np.linalg.norm(offset - place[..., None] * along[None, :, None], axis=-1)
    inside = (place > -reach) & (place < contacts.length[None, :, None] + reach)
    shares = (segments.regions[:, None, :, None] == contacts.regions[None, :, None, :]).any((2, 3))
    buried = (shares & inside.all(2) & (across < reach).all(2)).any(1)
    return segments.rows(np.flatnonzero(~buried))
