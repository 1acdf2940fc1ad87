"""Tukey's biweight (eq. 14 to 16)."""

import torch
from jaxtyping import Float
from torch import Tensor

EFFICIENT = 4.685
"""Cut-off in standard deviations that keeps 95 % of the efficiency under Gaussian noise."""
ZETA = 3.0
"""The factor of eq. 16."""


def biweight(v: Float[Tensor, "*batch"], c: float | Tensor) -> Float[Tensor, "*batch"]:
    """Weight (1 - (v/c)^2)^2 of a whitened residual, 0 beyond the cut-off (after eq. 15).

    Args:
        v: Residuals in standard deviations (eq. 15).
        c: Cut-off in standard deviations.
    """
    return (1.0 - (v / c).square()).clamp(min=0.0).square()


def biweight_cost(v: Float[Tensor, "*batch"], c: float | Tensor) -> Float[Tensor, "*batch"]:
    """rho(v) with rho'(v) = v biweight(v): v^2/2 near 0 and c^2/6 beyond the cut-off."""
    inside = 1.0 - (v / c).square().clamp(max=1.0)
    return (1.0 - inside**3) * (c**2 / 6.0)


def cutoff(v: Float[Tensor, " residual"], *, zeta: float = ZETA, least: float = EFFICIENT) -> float:
    """c = zeta median |v| (eq. 16), but not below ``least``; the median may only see outliers."""
    if v.numel() == 0:
        return least
    return max(zeta * float(v.abs().median()), least)


def robust_scale(v: Float[Tensor, " residual"]) -> float:
    """Standard deviation from the median of |v|; 1 for whitened Gaussian residuals."""
    return float(v.abs().median()) / 0.67449 if v.numel() else 1.0


def efficiency_factor(
    v: Float[Tensor, " residual"], c: float
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Mean of psi^2 and of psi' of the residuals inside the cut-off: the two parts of the sandwich."""
    u = (v / c).square()
    inside = u < 1
    psi_squared = torch.where(inside, v.square() * (1 - u) ** 4, 0.0)
    psi_slope = torch.where(inside, (1 - u) * (1 - 5 * u), 0.0)
    return psi_squared.mean(), psi_slope.mean()
