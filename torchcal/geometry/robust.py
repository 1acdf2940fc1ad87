"""Tukey's biweight (eq. 14 to 16)."""

import math
from typing import TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

EFFICIENT = 4.685
"""Cut-off in standard deviations that keeps 95 % of the efficiency under Gaussian noise."""
ZETA = 3.0
"""The factor of eq. 16."""
AGREEING = 3.0
"""Standard deviations within which a measurement agrees with what is expected of it."""
GAUSSIAN_MEDIAN = 0.6744897501960817
"""Median of |v| under Gaussian noise, in standard deviations."""
INLIER = 2.5
"""Standard deviations within which residuals tell about the noise: one in eighty is beyond."""
Cutoff = TypeVar("Cutoff", float, Tensor, float | Tensor)
ROUNDS = 50
"""Most repetitions of ``inlier_scale``."""
SETTLED = 1e-6
"""Relative change of a scale that ends its repetitions."""


def biweight(v: Float[Tensor, "*batch"], c: float | Tensor) -> Float[Tensor, "*batch"]:
    """Weight (1 - (v/c)^2)^2 of a whitened residual, 0 beyond the cut-off (after eq. 15).

    Args:
        v: Residuals in standard deviations (eq. 15).
        c: Cut-off in standard deviations.
    """
    return (1.0 - (v / c).square()).clamp(min=0.0).square()


def biweight_cost(v: Float[Tensor, "*batch"], c: float | Tensor) -> Float[Tensor, "*batch"]:
    """The cost rho(v) with rho'(v) = v biweight(v): v^2/2 near 0 and c^2/6 beyond the cut-off.

    Args:
        v: Residuals in standard deviations (eq. 15).
        c: Cut-off in standard deviations.
    """
    u = (v / c).square().clamp(max=1.0)
    # 1 - (1 - u)^3 multiplied out: small residuals would be lost in the subtraction.
    return rejected_cost(c) * u * (3.0 - 3.0 * u + u.square())


def rejected_cost(c: Cutoff) -> Cutoff:
    """The cost c^2/6 of every residual beyond the cut-off ``c`` (in standard deviations)."""
    return c**2 / 6.0


def cutoff(
    v: Float[Tensor, "*batch residual"], *, zeta: float = ZETA, least: float = EFFICIENT
) -> Float[Tensor, "*batch"]:
    """The cut-off c = zeta median |v| (eq. 16), but not below ``least``.

    Args:
        v: Residuals in standard deviations (eq. 15), NaN for those that are missing; ``least`` is
            returned where there are none.
        zeta: The factor of eq. 16.
        least: The median of a good fit's residuals would cut off good ones.
    """
    if v.shape[-1] == 0:
        return v.new_full(v.shape[:-1], least)
    return (zeta * v.abs().nanmedian(-1).values).nan_to_num(least).clamp(min=least)


def variance_inflation(c: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """By how much the biweight's estimate varies more than least squares on what it accepts.

    For Gaussian noise, with psi(v) = v biweight(v): E[psi^2] / E[psi']^2, and P(|v| < c) for the
    share of right residuals that is not accepted. 1.05 at ``EFFICIENT``.

    Args:
        c: Cut-off in standard deviations.
    """
    m0, m2, m4, m6, m8, m10 = _truncated_moments(c, 6)
    u = c.square().reciprocal()
    squared = m2 - 4 * u * m4 + 6 * u**2 * m6 - 4 * u**3 * m8 + u**4 * m10
    slope = m0 - 6 * u * m2 + 5 * u**2 * m4
    return m0 * squared / slope.square()


def weighted_variance(c: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """The same relative to the inverse of the weighted information A^T W A: 0.96 at ``EFFICIENT``.

    For Gaussian noise, with psi(v) = v biweight(v): E[biweight] E[psi^2] / E[psi']^2.

    Args:
        c: Cut-off in standard deviations.
    """
    m0, m2, m4 = _truncated_moments(c, 3)
    u = c.square().reciprocal()
    return (m0 - 2 * u * m2 + u**2 * m4) * variance_inflation(c) / m0


def relative_curvature(c: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Curvature of the biweight's cost over what its weights say: E[psi'] / E[biweight].

    For Gaussian noise; 0.83 at ``EFFICIENT``.

    Args:
        c: Cut-off in standard deviations.
    """
    m0, m2, m4 = _truncated_moments(c, 3)
    u = c.square().reciprocal()
    return (m0 - 6 * u * m2 + 5 * u**2 * m4) / (m0 - 2 * u * m2 + u**2 * m4)


def _truncated_moments(c: Tensor, count: int) -> list[Tensor]:
    """E[v^(2k); |v| < c] of a Gaussian for k = 0, 1, ..., by the recursion in k."""
    density = torch.exp(-0.5 * c.square()) / math.sqrt(2.0 * math.pi)
    moments = [torch.erf(c / math.sqrt(2.0))]
    for k in range(1, count):
        moments.append((2 * k - 1) * moments[-1] - 2.0 * c ** (2 * k - 1) * density)
    return moments


def robust_scale(v: Float[Tensor, " residual"]) -> float:
    """Standard deviation from the median of |v|; 1 for whitened Gaussian residuals or none."""
    return float(v.abs().median()) / GAUSSIAN_MEDIAN if v.numel() else 1.0


def inlier_scale(
    v: Float[Tensor, " residual"], *, limit: float = INLIER, rounds: int = ROUNDS
) -> float:
    """Standard deviation of the Gaussian part of residuals of which others are no noise.

    What is beyond ``limit`` of the result is left out, and the median of what is left compared with
    that of a Gaussian cut off there, so that residuals without others keep their standard
    deviation. 1 where there are none.

    Args:
        v: Residuals in standard deviations (eq. 15).
        limit: Of the result; what is within it counts.
        rounds: Most repetitions, from the median of all.
    """
    size, scale = v.abs(), robust_scale(v)
    for _ in range(rounds):
        before, kept = scale, size[size <= limit * scale]
        scale = float(kept.median()) / _cut_median(limit) if kept.numel() else scale
        if abs(scale - before) <= SETTLED * before:
            break
    return scale


def _cut_median(limit: float) -> float:
    """Median of |v| below ``limit`` under Gaussian noise, in standard deviations."""
    half = 0.5 * torch.erf(torch.tensor(limit / math.sqrt(2.0), dtype=torch.float64))
    return math.sqrt(2.0) * float(torch.erfinv(half))
