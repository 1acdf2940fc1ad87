"""Straight pieces along which the range jumps, from the gradient of the inverse range."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage

from torchcal.match.image.windows import Image

SCALE = 0.22
"""Standard deviation of the smoothing, in sides of the beam; at least one pixel and a quarter."""
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
"""Pixels between two pixels of one straight piece."""
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


def jump_segments(image: Image, shortest: float) -> Segments:
    """Ridges of the gradient, linked and cut into straight pieces of at least some pixels."""
    gradient = _gradient(image)
    ridge = _ridge(gradient, image.sensor.beam) & (gradient.size > GO_ON)
    v, u = np.nonzero(ridge)
    direction = np.stack([gradient.along_u[v, u], gradient.along_v[v, u]], -1)
    size = np.linalg.norm(direction, axis=1)
    direction /= size[:, None]
    pixel = np.stack([u, v], -1) + _peak(gradient, v, u, direction)[:, None] * direction
    found = _straight(pixel, direction, size, shortest)
    return Segments(ends=np.array(found).reshape(-1, 2, 2))


def _gradient(image: Image) -> _Gradient:
    scale = max(1.25, SCALE * image.sensor.beam)
    valid = image.valid.numpy()
    inverse = np.where(valid, 1.0 / image.range.numpy(), 0.0)
    noise = np.where(valid, image.sigma.numpy() / image.range.numpy() ** 2, 0.0)
    fine, coarse = (_smooth_gradient(inverse, valid, s) for s in (scale, WIDER * scale))
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


def _ridge(gradient: _Gradient, beam: int) -> Bool[ndarray, "h w"]:
    """Pixels with the largest gradient among those before and behind them."""
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
    pixel: Float[ndarray, "pixel 2"],
    direction: Float[ndarray, "pixel 2"],
    size: Float[ndarray, " pixel"],
    shortest: float,
) -> list[Float[ndarray, "2 2"]]:
    """Straight runs of pixels, grown from the largest gradients first."""
    free = np.ones(len(pixel), bool)
    found = []
    for seed in np.argsort(-size).tolist():
        if size[seed] < SEED:
            break
        if not free[seed]:
            continue
        run, along = _run(pixel, direction, free, seed)
        free[run] = False
        free[seed] = False
        place = (pixel[run] - pixel[seed]) @ along
        if len(run) > 2 and np.ptp(place) >= shortest:
            middle = pixel[run].mean(0)
            ends = (place.min(), place.max()) - (middle - pixel[seed]) @ along
            found.append(middle + np.outer(ends, along))
    return found


def _run(
    pixel: ndarray, direction: ndarray, free: ndarray, seed: int
) -> tuple[ndarray, Float[ndarray, "2"]]:
    """The pixels without a gap on the line through the seed, and the line's direction."""
    middle, normal = pixel[seed], direction[seed]
    run = np.array([seed])
    for reach in REACHES:
        along = np.array([-normal[1], normal[0]])
        apart = pixel - middle
        near = free & (np.abs(apart @ normal) < STRAIGHT) & (np.abs(direction @ normal) > TURN)
        (members,) = np.nonzero(near)
        place = (pixel[members] - pixel[seed]) @ along
        within = np.abs(place) < reach
        members, place = members[within], place[within]
        order = np.argsort(place)
        members, place = members[order], place[order]
        start = np.searchsorted(place, 0.0)
        gaps = np.nonzero(np.diff(place) > GAP)[0] + 1
        first = gaps[gaps <= start].max(initial=0)
        last = gaps[gaps > start].min(initial=len(members))
        run = members[first:last]
        if len(run) < 3:
            break
        middle = pixel[run].mean(0)
        _, axes = np.linalg.eigh((pixel[run] - middle).T @ (pixel[run] - middle))
        normal = axes[:, 0] * np.sign(axes[:, 0] @ normal)
    return run, np.array([-normal[1], normal[0]])
