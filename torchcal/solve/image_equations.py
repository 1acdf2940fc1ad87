"""Robust normal equations of one image whose noise has a slowly varying part (eq. 8 to 16).

The slowly varying part is eliminated: it is fitted together with the step (Schur complement), which
is the same as using the inverse of the full noise covariance for W of eq. 8.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.geometry import robust
from torchcal.solve.field import SmoothField

ROUNDS = 3
"""Rounds of reweighting in which the slowly varying part is separated."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ImageEquations:
    """One image's share of the normal equations, and what became of its pixels."""

    cost: Float[Tensor, ""]
    """Sum of rho of the whitened errors, with the prior of the slowly varying part."""
    information: Float[Tensor, "parameter parameter"]
    gradient: Float[Tensor, " parameter"]
    weight: Float[Tensor, "h w"]
    """Biweight of every pixel, 0 to 1; 0 where it is not compared."""
    drift: Float[Tensor, "h w"]
    """The slowly varying part (m)."""


def image_equations(
    residual: Float[Tensor, "h w"],
    jacobian: Float[Tensor, "h w parameter"],
    sigma: Float[Tensor, "h w"],
    compared: Bool[Tensor, "h w"],
    *,
    cutoff: float,
    field: SmoothField | None,
) -> ImageEquations:
    """Linearises one image about its residuals.

    Args:
        residual: Measured minus predicted (m); any finite number where not compared.
        jacobian: Derivative of the prediction to the parameters.
        sigma: Independent noise (m).
        compared: Pixels that count.
        cutoff: c of eq. 16 in standard deviations.
        field: The slowly varying part of the noise; None: all pixels are independent.
    """
    residual, sigma = residual.double(), sigma.double()
    drift = torch.zeros_like(residual)
    factor = coefficients = None
    for _ in range(ROUNDS if field else 0):
        assert field is not None
        precision = _weight(residual - drift, sigma, compared, cutoff) / sigma.square()
        factor = field.factorise(precision)
        pull = field.project(precision * residual)
        coefficients = torch.cholesky_solve(pull[:, None], factor)[:, 0]
        drift = field.expand(coefficients)
    error = residual - drift
    weight = _weight(error, sigma, compared, cutoff)
    information, gradient = _reduced(jacobian, error, weight / sigma.square(), field, coefficients)
    cost = torch.where(compared, robust.biweight_cost(error / sigma, cutoff), 0.0).sum()
    if field and coefficients is not None:
        cost = cost + 0.5 * field.precision * coefficients.square().sum()
    return ImageEquations(
        cost=cost, information=information, gradient=gradient, weight=weight, drift=drift
    )


def _weight(error: Tensor, sigma: Tensor, compared: Tensor, cutoff: float) -> Tensor:
    return torch.where(compared, robust.biweight(error / sigma, cutoff), 0.0)


def _reduced(
    jacobian: Tensor,
    error: Tensor,
    precision: Tensor,
    field: SmoothField | None,
    coefficients: Tensor | None,
) -> tuple[Tensor, Tensor]:
    """A^T W A and A^T W r, with the slowly varying part eliminated."""
    used = torch.nonzero(precision.flatten() > 0)[:, 0]
    H = jacobian.flatten(0, 1)[used].double()
    HW = H * precision.flatten()[used, None]
    information, gradient = H.mT @ HW, HW.mT @ error.flatten()[used]
    if field is None or coefficients is None:
        return information, gradient
    weighted = (jacobian.double() * precision[..., None]).movedim(-1, 0)
    coupling = field.project(weighted)
    factor = field.factorise(precision)
    solved = torch.cholesky_solve(coupling.mT, factor)
    pull = field.project(precision * error) - field.precision * coefficients
    return information - coupling @ solved, gradient - solved.mT @ pull
