"""Straight pieces along which the range jumps, from the gradient of the inverse range."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy import ndimage

from torchcal.match.image.blocks import Blocks

SCALE = 0.22
"""Standard deviation of the smoothing, in sides of the beam; at least one pixel and a quarter."""
OWN = 1.0 / 12.0 + 1.0 / 3.0
"""Variance of the smoothing by the mean over a block and by the difference two blocks apart."""
WIDER = 2.0
"""How much wider the smoothing is whose gradient is that of the surfaces, not of the edge."""
SEED, GO_ON = 6.0, 4.0
"""Standard deviations of a gradient that begins an edge, and of one that continues it."""
TURN = np.cos(np.radians(25.0))
"""Neighbouring pixels of one edge differ by less in the directions of their gradients."""
STRAIGHT = 2.0
"""Pixels by which the pixels of a straight piece may be off its line."""
ABOVE = 3.0
"""Standard deviations by which a gradient exceeds those half a beam before and behind."""
GAP = 5.0
"""Pixels between two pixels of one straight piece; one block may always be missing."""
REACHES = (10.0, 20.0, 50.0, 120.0, 1e9)
"""How far in pixels a piece may reach from its seed, one fit of its line after the other."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Segments:
    """Straight pieces in the image."""

    ends: Float[ndarray, "segment 2 2"]
    """Pixels; the range is shorter on the side to the left on the way from the first."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Gradient:
    """Of the inverse range, in standard deviations."""

    along_u: Float[ndarray, "h w"]
    """Less that of the surfaces around."""
    along_v: Float[ndarray, "h w"]
    raw: tuple[Float[ndarray, "h w"], Float[ndarray, "h w"]]
    """Along u and v, with that of the surfaces around."""
    size: Float[ndarray, "h w"]


@dataclass(frozen=True, kw_only=True, slots=True)
class _Ridges:
    """Where the gradient is largest."""

    row: Float[ndarray, " place"]
    """Pixels, in ascending order."""
    pixel: Float[ndarray, "place 2"]
    direction: Float[ndarray, "place 2"]
    """Of the gradient; unit vectors."""
    gap: float
    """Pixels that may be missing within one straight piece."""


def jump_segments(blocks: Blocks, shortest: float) -> Segments:
    """Ridges of the gradient, linked and cut into straight pieces of at least some pixels."""
    gradient = _gradient(blocks)
    v, u = np.nonzero(_ridge(gradient, blocks.beam / blocks.side))
    direction = np.stack([gradient.along_u[v, u], gradient.along_v[v, u]], -1)
    size = np.linalg.norm(direction, axis=1)
    direction /= size[:, None]
    place = np.stack([u, v], -1) + _peak(gradient, v, u, direction)[:, None] * direction
    ridges = _Ridges(
        row=blocks.side * v + blocks.offset,
        pixel=blocks.side * place + blocks.offset,
        direction=direction,
        gap=max(GAP, 2.0 * blocks.side * 2**0.5),
    )
    return Segments(ends=np.array(_straight(ridges, size, shortest)).reshape(-1, 2, 2))


def _gradient(image: Blocks) -> _Gradient:
    scale = max(1.25, SCALE * image.beam / image.side)
    valid = image.valid
    inverse = np.where(valid, 1.0 / image.range, 0.0)
    noise = np.where(valid, image.sigma / image.range**2, 0.0)
    own = OWN * (1.0 - 1.0 / image.side**2)
    fine, coarse = (
        _smooth_gradient(inverse, valid, (s**2 - own) ** 0.5) for s in (scale, WIDER * scale)
    )
    level = ndimage.gaussian_filter(noise, 2 * scale) / np.maximum(
        ndimage.gaussian_filter(valid.astype(float), 2 * scale), 1e-9
    )
    white = level / (np.sqrt(8 * np.pi) * scale**2)
    inside = ndimage.gaussian_filter(valid.astype(float), scale) > 0.6
    u, v = ((a - b) / np.maximum(white, 1e-12) * inside for a, b in zip(fine, coarse, strict=True))
    raw = tuple(a / np.maximum(white, 1e-12) for a in fine)
    return _Gradient(along_u=u, along_v=v, raw=(raw[0], raw[1]), size=np.hypot(u, v))


def _smooth_gradient(image: ndarray, valid: ndarray, scale: float) -> tuple[ndarray, ndarray]:
    """Along u and v, of the mean over the valid pixels (the image is 0 elsewhere)."""
    share = ndimage.gaussian_filter(valid.astype(float), scale, mode="nearest")
    mean = ndimage.gaussian_filter(image, scale, mode="nearest") / np.maximum(share, 1e-9)
    dv, du = np.gradient(mean)
    return np.asarray(du), np.asarray(dv)


def _sampled(gradient: _Gradient, v: ndarray, u: ndarray, direction: ndarray) -> ndarray:
    """The gradient along each pixel's own direction, bilinearly at places between pixels."""
    at = [v, u]
    return direction[:, 0] * ndimage.map_coordinates(
        gradient.along_u, at, order=1, mode="nearest"
    ) + direction[:, 1] * ndimage.map_coordinates(gradient.along_v, at, order=1, mode="nearest")


def _ridge(gradient: _Gradient, beam: float) -> Bool[ndarray, "h w"]:
    """Places with the largest gradient among those before and behind them."""
    v, u = np.nonzero(gradient.size > GO_ON)
    direction = np.stack([gradient.along_u[v, u], gradient.along_v[v, u]], -1)
    own = np.linalg.norm(direction, axis=1)
    direction /= own[:, None]
    before, behind = (
        _sampled(gradient, v + side * direction[:, 1], u + side * direction[:, 0], direction)
        for side in (1.0, -1.0)
    )
    ridge = np.zeros(gradient.size.shape, bool)
    far = 0.55 * max(beam, 3)
    top, *sides = (
        sum(
            direction[:, k]
            * ndimage.map_coordinates(
                raw,
                [v + far * s * direction[:, 1], u + far * s * direction[:, 0]],
                order=1,
                mode="nearest",
            )
            for k, raw in enumerate(gradient.raw)
        )
        for s in (0.0, 1.0, -1.0)
    )
    ridge[v, u] = (own >= before) & (own > behind) & (top - np.maximum(sides[0], sides[1]) > ABOVE)
    return ridge


def _peak(gradient: _Gradient, v: ndarray, u: ndarray, direction: ndarray) -> ndarray:
    """Where a parabola through three gradients has its top, in pixels along the gradient."""
    low, own, high = (
        _sampled(gradient, v + side * direction[:, 1], u + side * direction[:, 0], direction)
        for side in (-1.0, 0.0, 1.0)
    )
    bend = 2 * own - low - high
    return np.clip(0.5 * (high - low) / np.maximum(bend, 1e-9), -0.7, 0.7)


def _straight(
    ridges: _Ridges, size: Float[ndarray, " place"], shortest: float
) -> list[Float[ndarray, "2 2"]]:
    """Straight runs of places, grown from the largest gradients first."""
    pixel = ridges.pixel
    free = np.ones(len(pixel), bool)
    found = []
    for seed in np.argsort(-size).tolist():
        if size[seed] < SEED:
            break
        if not free[seed]:
            continue
        run, along = _run(ridges, free, seed)
        free[run] = False
        free[seed] = False
        place = (pixel[run] - pixel[seed]) @ along
        if len(run) > 2 and np.ptp(place) >= shortest:
            middle = pixel[run].mean(0)
            ends = (place.min(), place.max()) - (middle - pixel[seed]) @ along
            found.append(middle + np.outer(ends, along))
    return found


def _run(
    ridges: _Ridges, free: Bool[ndarray, " place"], seed: int
) -> tuple[Int[ndarray, " member"], Float[ndarray, "2"]]:
    """The places without a gap on the line through the seed, and the line's direction."""
    middle, normal = ridges.pixel[seed], ridges.direction[seed]
    run = np.array([seed])
    for reach in REACHES:
        members, place = _on_line(ridges, free, seed, (middle, normal), reach)
        start = np.searchsorted(place, 0.0)
        gaps = np.nonzero(np.diff(place) > ridges.gap)[0] + 1
        first = gaps[gaps <= start].max(initial=0)
        last = gaps[gaps > start].min(initial=len(members))
        grown = len(run) < last - first
        run = members[first:last]
        if len(run) < 3 or not grown:
            break
        middle = ridges.pixel[run].mean(0)
        normal = _normal(ridges.pixel[run] - middle, normal)
    return run, np.array([-normal[1], normal[0]])


def _on_line(
    ridges: _Ridges, free: ndarray, seed: int, line: tuple[ndarray, ndarray], reach: float
) -> tuple[Int[ndarray, " member"], Float[ndarray, " member"]]:
    """Free places near a line and within reach of the seed, in order along it."""
    middle, normal = line
    pixel = ridges.pixel[seed]
    first, last = np.searchsorted(
        ridges.row, (ridges.row[seed] - reach - STRAIGHT, ridges.row[seed] + reach + STRAIGHT)
    )
    part = slice(first, last)
    near = np.abs((ridges.pixel[part] - middle) @ normal) < STRAIGHT
    (members,) = np.nonzero(near & free[part])
    members = members[np.abs(ridges.direction[part][members] @ normal) > TURN] + first
    place = (ridges.pixel[members] - pixel) @ np.array([-normal[1], normal[0]])
    within = np.abs(place) < reach
    members, place = members[within], place[within]
    order = np.argsort(place)
    return members[order], place[order]


def _normal(apart: Float[ndarray, "member 2"], like: Float[ndarray, "2"]) -> Float[ndarray, "2"]:
    """Across the direction in which places spread most, on the same side as another one."""
    (a, b), (_, c) = apart.T @ apart
    angle = 0.5 * np.arctan2(2 * b, a - c)
    normal = np.array([-np.sin(angle), np.cos(angle)])
    return normal if normal @ like > 0 else -normal
