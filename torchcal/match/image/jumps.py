"""Jump edges of a range image: straight borders of nearer surfaces."""

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray

from torchcal.match.features import LineKind
from torchcal.match.image.blocks import Blocks
from torchcal.match.image.creases import Found
from torchcal.match.image.strips import Strip, central_ray, fit_strip
from torchcal.match.image.windows import Image

SURE = 5.0
"""Standard deviations of a jump that is no accident."""
SMALLEST = 0.3
"""Standard deviations of one pixel's noise: the smallest jump."""
BEYOND = 1.0
"""Pixels by which a jump may be off."""
FITS = 1.6
"""The largest chi-square per degree of freedom of two planes with a straight border."""
SHORTEST_PART = 30.0
"""Pixels below which a segment is cut no further."""
MEETING = 0.25
"""Of the beam's side: planes that meet nearer to the line have a crease there, no jump."""
UNSURE = np.radians(1.8)
"""A line whose direction in the image is less sure than this standard deviation is none."""


def jumps(
    image: Image,
    blocks: Blocks,
    segments: Float[ndarray, "segment 2 2"],
    sides: Float[ndarray, "segment 2"],
) -> list[Found]:
    """The segments along which the range jumps, fitted to the strips along them."""
    found = []
    for segment, (left, right) in zip(segments, sides, strict=True):
        for strip, part in _parts(blocks, segment, (float(left), float(right))):
            line = _line(image, strip, part)
            if line:
                found.append(line)
    return found


def _parts(
    blocks: Blocks, segment: Float[ndarray, "2 2"], sides: tuple[float, float]
) -> list[tuple[Strip, Float[ndarray, "2 2"]]]:
    """Strips with one plane on either side: halves, where the whole segment has more of them."""
    strip = fit_strip(blocks, segment, sides)
    length = np.linalg.norm(segment[1] - segment[0])
    if strip is not None and (
        strip.chi2 - 1 < (FITS - 1) * blocks.side**2 or length < 2 * SHORTEST_PART
    ):
        return [(strip, segment)]
    if length < 2 * SHORTEST_PART:
        return []
    middle = segment.mean(0)
    halves = np.stack([segment[0], middle]), np.stack([middle, segment[1]])
    return [part for half in halves for part in _parts(blocks, half, sides)]


def _line(image: Image, strip: Strip, segment: Float[ndarray, "2 2"]) -> Found | None:
    """The line on the nearer plane; None where the range does not jump for sure."""
    middle = strip.ends.mean(0)
    beam = max(image.sensor.beam, 3)
    turn = np.sqrt(strip.covariance[7, 7])
    if turn > UNSURE or np.linalg.norm(strip.ends - segment, axis=1).max() > 0.8 * beam:
        return None
    ray, du, dv = central_ray(image, middle)
    apart = strip.m_near - strip.m_far
    slope = np.array([du @ apart, dv @ apart]) @ strip.normal
    if abs(apart @ ray) < max(2.0, MEETING * beam) * abs(slope):
        return None
    near, far = 1.0 / (strip.m_near @ ray), 1.0 / (strip.m_far @ ray)
    gradient = np.zeros(8)
    gradient[:3], gradient[3:6] = near**2 * ray, -(far**2) * ray
    sigma = float(np.sqrt(gradient @ strip.covariance @ gradient))
    noise = float(image.sensor.noise.sigma(image.range.new_tensor(near)))
    if not 0 < near < image.sensor.far or far - near < max(SURE * sigma, SMALLEST * noise):
        return None
    return _on_plane(image, strip, (ray, du, dv))


def _on_plane(image: Image, strip: Strip, optics: tuple[ndarray, ndarray, ndarray]) -> Found:
    rays = np.stack([central_ray(image, end)[0] for end in strip.ends])
    inverse = rays @ strip.m_near
    ends = rays / inverse[:, None]
    length = np.linalg.norm(strip.ends[1] - strip.ends[0])
    jacobian = np.zeros((6, 8))
    for k, side in enumerate((-0.5, 0.5)):
        _, du, dv = central_ray(image, strip.ends[k])
        moved = du * strip.normal[0] + dv * strip.normal[1]
        project = np.eye(3) / inverse[k] - np.outer(rays[k], strip.m_near) / inverse[k] ** 2
        rows = slice(3 * k, 3 * k + 3)
        jacobian[rows, :3] = -np.outer(rays[k], rays[k]) / inverse[k] ** 2
        jacobian[rows, 6] = project @ moved
        jacobian[rows, 7] = project @ moved * side * length
    return _from_ends(image, strip, ends, jacobian @ strip.covariance @ jacobian.T)


def _from_ends(image: Image, strip: Strip, ends: Float[ndarray, "2 3"], both: ndarray) -> Found:
    """Point and direction with their covariance from that of both ends."""
    along = ends[1] - ends[0]
    length = np.linalg.norm(along)
    direction = along / length
    off_axis = (np.eye(3) - np.outer(direction, direction)) / length
    jacobian = np.block([[np.eye(3) / 2, np.eye(3) / 2], [-off_axis, off_axis]])
    return Found(
        pixels=strip.ends,
        ends=ends,
        point=ends.mean(0),
        direction=direction,
        covariance=jacobian @ both @ jacobian.T,
        kind=LineKind.JUMP,
        dihedral=np.nan,
        dihedral_sigma=np.inf,
        planes=(-1, -1),
    )


def blurred_by(image: Image, found: list[Found]) -> Bool[ndarray, "h w"]:
    """Pixels whose beams meet both sides of a jump."""
    half = max(image.sensor.beam, 1) / 2 + BEYOND
    blurred = np.zeros(image.range.shape, bool)
    for line in found:
        ends = line.pixels
        low = np.maximum(np.floor(ends.min(0) - half), 0).astype(int)
        high = np.maximum(np.ceil(ends.max(0) + half), 0).astype(int) + 1
        box = blurred[low[1] : high[1], low[0] : high[0]]
        v, u = np.indices(box.shape)
        apart = np.stack([u, v], -1) + (low - ends[0])
        length = np.linalg.norm(ends[1] - ends[0])
        along = (ends[1] - ends[0]) / length
        place, across = apart @ along, apart @ np.array([-along[1], along[0]])
        square = half * np.abs(along).sum()
        box |= (np.abs(across) < square) & (place > -half) & (place < length + half)
    return blurred
