"""Tukey's biweight (eq. 14 to 16)."""

from jaxtyping import Float
from torch import Tensor

EFFICIENT = 4.685
"""Cut-off in standard deviations that keeps 95 % of the efficiency under Gaussian noise."""
ZETA = 3.0
"""The factor of eq. 16."""
GAUSSIAN_MEDIAN = 0.6744897501960817
"""Median of |v| under Gaussian noise, in standard deviations."""


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
    return (c**2 / 6.0) * u * (3.0 - 3.0 * u + u.square())


def cutoff(v: Float[Tensor, " residual"], *, zeta: float = ZETA, least: float = EFFICIENT) -> float:
    """The cut-off c = zeta median |v| (eq. 16), but not below ``least``.

    Args:
        v: Residuals in standard deviations (eq. 15); ``least`` is returned where there are none.
        zeta: The factor of eq. 16.
        least: The median of a good fit's residuals would cut off good ones.
    """
    if v.numel() == 0:
        return least
    return max(zeta * float(v.abs().median()), least)


def robust_scale(v: Float[Tensor, " residual"]) -> float:
    """Standard deviation from the median of |v|; 1 for whitened Gaussian residuals or none."""
    return float(v.abs().median()) / GAUSSIAN_MEDIAN if v.numel() else 1.0
