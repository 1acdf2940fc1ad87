"""Creases of a range image: where two planes that touch in it meet."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy import ndarray
from scipy import ndimage

from torchcal.match.features import LineKind
from torchcal.match.image.labels import Planar
from torchcal.match.image.windows import Image

NEAR = 5.0
"""Pixels between the border of two planes in the image and the crease of both."""
STRAIGHT = 2.5
"""Pixels (rms) by which a border may be off a straight line."""
GAP = 12.0
"""Pixels of a border that may be missing within one crease."""
SEEN = 1.5
"""Areas of the beam that must show each plane of a crease alone: fewer may be a mixture."""
FITS = 1.6
"""The largest chi-square per degree of freedom of a plane with a crease."""
SMALLEST_ANGLE = np.radians(4.0)
SURE = 4.0
"""Standard deviations of a dihedral angle that is no accident."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Found:
    """One line in the sensor's frame."""

    pixels: Float[ndarray, "2 2"]
    """Its ends in the image."""
    ends: Float[ndarray, "2 3"]
    """m"""
    point: Float[ndarray, "3"]
    direction: Float[ndarray, "3"]
    covariance: Float[ndarray, "6 6"]
    """Of point and direction."""
    kind: LineKind
    dihedral: float
    """rad; NaN for a jump."""
    dihedral_sigma: float
    planes: tuple[int, int]


def found_creases(image: Image, planar: Planar, shortest: float) -> list[Found]:
    """Where planes that touch in the image meet, for at least some pixels."""
    least = SEEN * max(image.sensor.beam, 1) ** 2
    alone = np.bincount(planar.label[planar.pure], minlength=len(planar.m))
    sure = (alone >= least) & (planar.chi2.numpy() < FITS)
    return [
        line
        for pair, rows, columns in _borders(planar.label, shortest)
        if sure[pair].all()
        for line in _of_pair(image, planar, pair, rows, columns, shortest)
    ]


def straight_borders(
    image: Image, planar: Planar, shortest: float
) -> Float[ndarray, "segment 2 2"]:
    """Straight borders in the image of planes at least some pixels long, the nearer to the left."""
    found = []
    m = planar.m.numpy()
    for pair, rows, columns in _borders(planar.label, shortest):
        pixel = np.stack([columns, rows], -1).astype(float)
        middle = pixel.mean(0)
        spread, axes = np.linalg.eigh((pixel - middle).T @ (pixel - middle) / len(pixel))
        place = (pixel - middle) @ axes[:, 1]
        if np.sqrt(spread[0]) > STRAIGHT or np.ptp(place) < shortest:
            continue
        ends = middle + np.outer([place.min(), place.max()], axes[:, 1])
        normal = np.array([axes[1, 1], -axes[0, 1]])
        own = planar.label[rows, columns]
        left = (pixel - middle) @ normal
        first = left[own == pair[0]].mean() if (own == pair[0]).any() else -1.0
        rays = image.rays.numpy()[rows, columns].mean(0)
        nearer_left = (rays @ (m[pair[0]] - m[pair[1]]) > 0) == (first > left.mean())
        found.append(ends if nearer_left else ends[::-1])
    return np.array(found).reshape(-1, 2, 2)


def _borders(
    label: Int[ndarray, "h w"], shortest: float
) -> Iterator[tuple[Int[ndarray, "2"], Int[ndarray, " pixel"], Int[ndarray, " pixel"]]]:
    """Each pair of planes side by side, and the rows and columns of their border."""
    rows, columns, pairs = _border(label)
    if len(pairs) == 0:
        return
    names, which = np.unique(pairs, axis=0, return_inverse=True)
    which = which.ravel()
    order = np.argsort(which, kind="stable")
    for members in np.split(order, np.nonzero(np.diff(which[order]))[0] + 1):
        if len(members) >= 0.5 * shortest:
            yield names[which[members[0]]], rows[members], columns[members]


def _border(
    label: Int[ndarray, "h w"],
) -> tuple[Int[ndarray, " pixel"], Int[ndarray, " pixel"], Int[ndarray, "pixel 2"]]:
    """Pixels beside another plane, and the two planes."""
    parts = []
    for dv, du in ((0, 2), (2, 0)):
        h, w = label.shape
        one, other = label[: h - dv, : w - du], label[dv:, du:]
        v, u = np.nonzero((one != other) & (one >= 0) & (other >= 0))
        pair = np.sort(np.stack([one[v, u], other[v, u]], -1), axis=1)
        parts.append((v + dv / 2, u + du / 2, pair))
    v, u, pair = (np.concatenate(each) for each in zip(*parts, strict=True))
    return v.astype(int), u.astype(int), pair


def _of_pair(
    image: Image,
    planar: Planar,
    pair: Int[ndarray, "2"],
    rows: Int[ndarray, " pixel"],
    columns: Int[ndarray, " pixel"],
    shortest: float,
) -> list[Found]:
    """The parts of the border of two planes that lie on their common line."""
    m = planar.m.numpy()[pair]
    direction = np.cross(m[0], m[1])
    angle, sigma = dihedral(m, planar.covariance.numpy()[pair] * planar.excess)
    if angle < max(SMALLEST_ANGLE, SURE * sigma):
        return []
    direction /= np.linalg.norm(direction)
    rays = image.rays.numpy()[rows, columns]
    right = image.rays.numpy()[rows, np.minimum(columns + 1, image.range.shape[1] - 1)]
    down = image.rays.numpy()[np.minimum(rows + 1, image.range.shape[0] - 1), columns]
    apart = m[0] - m[1]
    slope = np.hypot((right - rays) @ apart, (down - rays) @ apart)
    close = np.abs(rays @ apart) < NEAR * np.maximum(slope, 1e-12)
    if close.sum() < 0.5 * shortest:
        return []
    points = rays[close] / (rays[close] @ m.mean(0))[:, None]
    place = points @ direction
    order = np.argsort(place)
    at = np.stack([columns[close], rows[close]], -1)[order]
    jumps = np.linalg.norm(np.diff(at.astype(float), axis=0), axis=1) > GAP
    kind = _kind(image, planar, pair, rows[close], columns[close])
    return [
        _found(image, planar, pair, (place[order][part[0]], place[order][part[-1]]), kind)
        for part in np.split(np.arange(len(place)), np.nonzero(jumps)[0] + 1)
        if np.linalg.norm(at[part[-1]] - at[part[0]]) >= shortest
    ]


def _kind(image: Image, planar: Planar, pair: ndarray, rows: ndarray, columns: ndarray) -> LineKind:
    """A convex crease lies before the prolongations of its planes, a concave one behind them."""
    reach = max(image.sensor.beam, 4)
    box = np.s_[
        max(rows.min() - reach, 0) : rows.max() + reach,
        max(columns.min() - reach, 0) : columns.max() + reach,
    ]
    near = np.zeros(image.range.shape, bool)
    near[rows, columns] = True
    around = ndimage.maximum_filter(near[box], 2 * reach + 1)
    m = planar.m.numpy()[pair]
    apart = image.rays.numpy()[box] @ (m[0] - m[1])
    first, second = ((planar.label[box] == each) & around for each in pair)
    votes = np.sign(apart[first]).sum() - np.sign(apart[second]).sum()
    return LineKind.CONVEX if votes < 0 else LineKind.CONCAVE


def dihedral(m: Float[ndarray, "2 3"], covariance: Float[ndarray, "2 3 3"]) -> tuple[float, float]:
    """The angle between two planes' normals and its standard deviation (rad)."""
    sizes = np.linalg.norm(m, axis=1)
    normals = m / sizes[:, None]
    across = np.cross(normals[0], normals[1])
    sine = np.linalg.norm(across)
    angle = float(np.arctan2(sine, normals[0] @ normals[1]))
    axis = across / max(sine, 1e-9)
    sides = [np.cross(axis, normal) / size for normal, size in zip(normals, sizes, strict=True)]
    variance = sum(side @ part @ side for side, part in zip(sides, covariance, strict=True))
    return angle, float(np.sqrt(max(variance, 0.0)))


def _found(
    image: Image,
    planar: Planar,
    pair: Int[ndarray, "2"],
    span: tuple[float, float],
    kind: LineKind,
) -> Found:
    m = planar.m.numpy()[pair]
    covariance = planar.covariance.numpy()[pair] * planar.excess
    direction = np.cross(m[0], m[1])
    direction /= np.linalg.norm(direction)
    inverse = np.linalg.inv(np.stack([m[0], m[1], direction]))
    first, middle, last = (
        inverse @ np.array([1.0, 1.0, place]) for place in (span[0], sum(span) / 2, span[1])
    )
    both = np.zeros((6, 6))
    both[:3, :3], both[3:, 3:] = covariance
    point, direction, full = crease_covariance(m, both, middle)
    angle, sigma = dihedral(m, covariance)
    ends = np.stack([first, last])
    return Found(
        pixels=projected(image, ends),
        ends=ends,
        point=point,
        direction=direction,
        covariance=full,
        kind=kind,
        dihedral=angle,
        dihedral_sigma=sigma,
        planes=(int(pair[0]), int(pair[1])),
    )


def crease_covariance(
    m: Float[ndarray, "2 3"], covariance: Float[ndarray, "6 6"], place: Float[ndarray, "3"]
) -> tuple[Float[ndarray, "3"], Float[ndarray, "3"], Float[ndarray, "6 6"]]:
    """Point (near a place), direction and their covariance of the line on which planes meet."""
    across = np.cross(m[0], m[1])
    length = np.linalg.norm(across)
    direction = across / length
    inverse = np.linalg.inv(np.stack([m[0], m[1], direction]))
    point = inverse @ np.array([1.0, 1.0, place @ direction])
    off_axis = (np.eye(3) - np.outer(direction, direction)) / length
    jacobian = np.zeros((6, 6))
    jacobian[:3, :3] = -np.outer(inverse[:, 0], point)
    jacobian[:3, 3:] = -np.outer(inverse[:, 1], point)
    jacobian[3:, :3] = -off_axis @ _cross(m[1])
    jacobian[3:, 3:] = off_axis @ _cross(m[0])
    return point, direction, jacobian @ covariance @ jacobian.T


def projected(image: Image, points: Float[ndarray, "*batch 3"]) -> Float[ndarray, "*batch 2"]:
    """Where points (m) are in the image."""
    return image.sensor.projection.pixels(image.range.new_tensor(points)).numpy()


def _cross(vector: Float[ndarray, "3"]) -> Float[ndarray, "3 3"]:
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
