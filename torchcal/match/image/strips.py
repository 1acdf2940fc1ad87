"""Two planes with a straight border, blurred by the beam, fitted to the strip along a segment."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from torchcal.match.image.blocks import Blocks
from torchcal.match.image.windows import Image

MOST = 2500
"""Blocks of a strip that are used."""
STEEP = 3.0
"""The standard deviation of planes' slopes before anything is measured."""
SETTLED = 0.5
"""Standard deviations: what smaller steps leave is far below the noise."""
LEAST = 30
"""Pixels that must be measured in a strip."""
FEWEST = 2
"""Blocks on either side."""
ROUNDS = 5
SURE = 2.0
"""Standard deviations of chi-square that are no accident."""
FLATTEST = 0.1
"""Share of the typical inverse range below which no surface may fall in a strip."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Strip:
    """One segment's two planes and its line. Parameters: m near, m far, shift, turn."""

    ends: Float[ndarray, "2 2"]
    """Pixels, on the line as fitted."""
    m_near: Float[ndarray, "3"]
    m_far: Float[ndarray, "3"]
    covariance: Float[ndarray, "8 8"]
    chi2: float
    """For each degree of freedom."""
    normal: Float[ndarray, "2"]
    """Unit vector in the image, to the nearer side."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Pixels:
    at: Float[ndarray, "pixel 2"]
    """From the segment's middle."""
    range: Float[ndarray, " pixel"]
    sigma: Float[ndarray, " pixel"]
    rays: Float[ndarray, "pixel 3"]
    slopes: Float[ndarray, "pixel 2 3"]
    """The derivatives of the rays to u and to v."""
    typical: float
    """m: the median range."""


def fit_strip(
    blocks: Blocks, ends: Float[ndarray, "2 2"], sides: tuple[float, float]
) -> Strip | None:
    """Least squares for both planes and the line; None where too little is measured.

    Args:
        blocks: The measured image.
        ends: Of the segment, in pixels; the nearer surface is to its left.
        sides: Pixels to which the strip may reach to the nearer and to the farther side.
    """
    length = float(np.linalg.norm(ends[1] - ends[0]))
    along = (ends[1] - ends[0]) / length
    normal = np.array([along[1], -along[0]])
    middle = ends.mean(0)
    pixels = _pixels(blocks, middle, along, length, sides)
    beam = blocks.beam
    if pixels is None:
        return None
    start = _start(pixels, normal, beam)
    if start is None:
        return None
    fitted = _fit(pixels, start, normal, beam, length)
    if fitted is None:
        return None
    values, covariance, chi2 = fitted
    shift, turn = values[6], values[7]
    offset = shift + np.tan(turn) * np.array([-0.5, 0.5]) * length
    return Strip(
        ends=ends + offset[:, None] * normal,
        m_near=values[:3],
        m_far=values[3:6],
        covariance=covariance,
        chi2=chi2,
        normal=normal,
    )


def central_ray(image: Image, pixel: Float[ndarray, "2"]) -> tuple[ndarray, ndarray, ndarray]:
    """The ray of a pixel and its derivatives to u and v."""
    u, v = image.range.new_tensor(pixel)
    projection = image.sensor.projection
    du, dv = projection.ray_derivatives(u, v)
    return projection.rays(u, v).numpy(), du.numpy(), dv.numpy()


def _pixels(
    blocks: Blocks, middle: ndarray, along: ndarray, length: float, sides: tuple[float, float]
) -> _Pixels | None:
    trim = min(blocks.beam / 2, length / 4)
    normal = np.array([along[1], -along[0]])
    span = np.abs(along) * length / 2 + np.abs(normal) * max(sides)
    start, stop = ((middle + sign * span - blocks.offset) / blocks.side for sign in (-1.0, 1.0))
    low = np.maximum(np.floor(start), 0).astype(int)
    high = np.minimum(np.ceil(stop) + 1, blocks.range.shape[::-1]).astype(int)
    if (high <= low).any():
        return None
    v, u = (
        blocks.side * each + blocks.offset for each in np.mgrid[low[1] : high[1], low[0] : high[0]]
    )
    at = np.stack([u - middle[0], v - middle[1]], -1)
    across, place = at @ normal, at @ along
    inside = (np.abs(place) <= length / 2 - trim) & (across < sides[0]) & (across > -sides[1])
    rows, columns = np.nonzero(inside & blocks.valid[low[1] : high[1], low[0] : high[0]])
    if len(rows) * blocks.side**2 < LEAST:
        return None
    step = 1 + len(rows) // MOST
    rows, columns = rows[::step], columns[::step]
    return _taken(blocks, at[rows, columns], rows + low[1], columns + low[0])


def _taken(blocks: Blocks, at: ndarray, rows: ndarray, columns: ndarray) -> _Pixels:
    ranges = blocks.range[rows, columns]
    return _Pixels(
        at=at,
        range=ranges,
        sigma=blocks.sigma[rows, columns],
        rays=blocks.rays[rows, columns],
        slopes=blocks.slopes(rows, columns),
        typical=float(np.median(ranges)),
    )


def _start(pixels: _Pixels, normal: ndarray, beam: float) -> Float[ndarray, "8"] | None:
    across = pixels.at @ normal
    planes = []
    for side in (1.0, -1.0):
        own = across * side > 0.25 * beam
        if own.sum() < FEWEST:
            return None
        rays, ranges, sigma = pixels.rays[own], pixels.range[own], pixels.sigma[own]
        typical = float(np.median(ranges))
        weight = (typical**2 / sigma)[:, None]
        prior = _prior(rays.mean(0), typical)
        information = (rays * weight).T @ (rays * weight) + prior
        planes.append(np.linalg.solve(information, (rays * weight**2).T @ (1.0 / ranges)))
    return np.concatenate([*planes, [0.0, 0.0]])


def _prior(ray: Float[ndarray, "3"], typical: float) -> Float[ndarray, "3 3"]:
    """The information that surfaces are rarely steep."""
    ray = ray / np.linalg.norm(ray)
    return (typical / STEEP) ** 2 * (np.eye(3) - np.outer(ray, ray))


def _fit(
    pixels: _Pixels, values: ndarray, normal: ndarray, beam: float, length: float
) -> tuple[ndarray, ndarray, float] | None:
    typical = pixels.typical
    prior = np.zeros((8, 8))
    prior[:3, :3] = prior[3:6, 3:6] = _prior(pixels.rays.mean(0), typical)
    prior[6, 6], prior[7, 7] = (1.0 / beam) ** 2 / 4, (length / beam) ** 2 / 16
    limit = np.array([beam / 4.0, beam / (2 * length)])
    for _ in range(ROUNDS):
        residual, jacobian = _whitened(pixels, values, normal, beam)
        step, covariance = _solved(jacobian, residual, prior, values)
        step[6:] = np.clip(step[6:], -limit, limit)
        values = values + step
        if (np.abs(step) < SETTLED * np.sqrt(np.diag(covariance))).all():
            break
    if not np.isfinite(values).all():
        return None
    residual, jacobian = _whitened(pixels, values, normal, beam)
    _, covariance = _solved(jacobian, residual, prior, values)
    chi2 = float(residual @ residual) / max(len(residual) - 8, 1)
    # Errors of the model have one sign all along the strip: noise alone would average out.
    surplus = max(0.0, chi2 - 1.0 - SURE * (2.0 / len(residual)) ** 0.5) * len(residual) / 8
    return values, covariance * (1.0 + surplus), chi2


def _whitened(
    pixels: _Pixels, values: ndarray, normal: ndarray, beam: float
) -> tuple[Float[ndarray, " pixel"], Float[ndarray, "pixel 8"]]:
    """Residuals and their model's derivatives in standard deviations."""
    model, jacobian = _model(pixels, values, normal, beam)
    return (pixels.range - model) / pixels.sigma, jacobian / pixels.sigma[:, None]


def _solved(
    jacobian: ndarray, residual: ndarray, prior: ndarray, values: ndarray
) -> tuple[Float[ndarray, "8"], Float[ndarray, "8 8"]]:
    """The Gauss-Newton step, and the covariance."""
    information = jacobian.T @ jacobian + prior
    scale = 1.0 / np.sqrt(np.diag(information))
    both = np.outer(scale, scale)
    covariance = np.linalg.inv(information * both) * both
    return covariance @ (jacobian.T @ residual - prior @ values), covariance


def _model(
    pixels: _Pixels, values: ndarray, normal: ndarray, beam: float
) -> tuple[Float[ndarray, " pixel"], Float[ndarray, "pixel 8"]]:
    turned = normal + np.tan(values[7]) * np.array([normal[1], -normal[0]])
    turned = turned / np.linalg.norm(turned)
    along = np.array([-normal[1], normal[0]])
    across = pixels.at @ turned - values[6]
    share, density, moment = beam_share(across, beam * np.abs(turned))
    near, near_slope = _plane(pixels, values[:3], turned)
    far, far_slope = _plane(pixels, values[3:6], turned)
    model = share * near + (1 - share) * far + moment * (near_slope - far_slope)
    at_line = density * (near - far - across * (near_slope - far_slope))
    jacobian = np.empty((len(model), 8))
    jacobian[:, :3] = -(share * near**2)[:, None] * pixels.rays
    jacobian[:, 3:6] = -((1 - share) * far**2)[:, None] * pixels.rays
    jacobian[:, 6] = -at_line
    jacobian[:, 7] = -at_line * (pixels.at @ along)
    return model, jacobian


def _plane(pixels: _Pixels, m: ndarray, normal: ndarray) -> tuple[ndarray, ndarray]:
    """Ranges of a plane, and how they change from pixel to pixel along a direction."""
    inverse = np.maximum(pixels.rays @ m, FLATTEST / pixels.typical)
    slope = (pixels.slopes @ m) @ normal
    return 1.0 / inverse, -slope / inverse**2


def beam_share(
    across: Float[ndarray, " pixel"], widths: Float[ndarray, "2"]
) -> tuple[ndarray, ndarray, ndarray]:
    """What of a square beam lies beyond a straight line (eq. 17).

    Args:
        across: Distance (pixels) of the beam's middle from the line.
        widths: The lengths of the square's two sides as they project across the line.

    Returns:
        The share of its area, its derivative to the distance, and the integral over that share of
        the distance from the beam's middle.
    """
    wide, narrow = max(widths.max(), 1e-6), max(widths.min(), 1e-3 * widths.max())
    knots = np.array([1.0, -1.0, -1.0, 1.0])
    corner = np.array([-wide - narrow, -wide + narrow, wide - narrow, wide + narrow]) / 2
    ramp = np.maximum(across[:, None] - corner, 0.0)
    scale = knots / (wide * narrow)
    density = ramp @ scale
    share = (ramp**2 / 2) @ scale
    # The integral of -e f(e) from the far corner up to the distance, by parts.
    moment = (ramp**3 / 6) @ scale - across * share
    return share, density, moment
