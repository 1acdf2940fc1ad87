"""Robust normal equations of one image whose noise has a slowly varying part (eq. 8 to 16).

The slowly varying part is eliminated: it is fitted together with the step (Schur complement), which
is the same as using the inverse of the full noise covariance for W of eq. 8.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.geometry import robust
from torchcal.solve.field import FieldSystem, SmoothField

ROUNDS = 3
"""Rounds of reweighting in which the slowly varying part is separated."""


@dataclass(frozen=True, kw_only=True, slots=True)
class RobustImage:
    """An image's residuals with robust weights and the slowly varying part taken out."""

    error: Float[Tensor, "h w"]
    """Residual without the slowly varying part (m)."""
    precision: Float[Tensor, "h w"]
    """W' after eq. 15: biweight over variance (1/m^2); 0 where not compared."""
    cost: Float[Tensor, ""]
    """Sum of rho, with the prior of the slowly varying part."""
    field: SmoothField | None
    coefficients: Float[Tensor, " coefficient"]
    """Of the slowly varying part; empty without one."""
    system: FieldSystem | None


def robust_image(
    residual: Float[Tensor, "h w"],
    sigma: Float[Tensor, "h w"],
    compared: Bool[Tensor, "h w"],
    *,
    cutoff: float,
    field: SmoothField | None,
) -> RobustImage:
    """Separates residuals (m) into slowly varying part, independent noise and outliers.

    Args:
        residual: Measured minus predicted; any finite number where not compared.
        sigma: Independent noise (m).
        compared: Pixels that count.
        cutoff: c of eq. 16 in standard deviations.
        field: The slowly varying part of the noise; None: all pixels are independent.
    """
    residual, sigma = residual.double(), sigma.double()
    error, system, coefficients = residual, None, residual.new_zeros(0)
    precision = _precision(error, sigma, compared, cutoff)
    for last in reversed(range(ROUNDS if field else 0)):
        assert field is not None, "there are rounds only with a field"
        system = field.system(precision)
        coefficients = system.solve(field.project(precision * residual))
        error = residual - field.expand(coefficients)
        if last:  # the weights that were factorised last stay: the information is then definite
            precision = _precision(error, sigma, compared, cutoff)
    cost = torch.where(compared, robust.biweight_cost(error / sigma, cutoff), 0.0).sum()
    if field is not None:
        cost = cost + 0.5 * field.precision * coefficients.square().sum()
    return RobustImage(
        error=error,
        precision=precision,
        cost=cost,
        field=field,
        coefficients=coefficients,
        system=system,
    )


def _precision(error: Tensor, sigma: Tensor, compared: Tensor, cutoff: float) -> Tensor:
    return torch.where(compared, robust.biweight(error / sigma, cutoff) / sigma.square(), 0.0)


def reduced_jacobian(
    image: RobustImage, jacobian: Float[Tensor, "h w parameter"]
) -> Float[Tensor, "h w parameter"]:
    """The Jacobian without what the slowly varying part could explain: (I - Phi M^-1 Phi^T W) A."""
    columns = jacobian.double()
    if image.field is None or image.system is None:
        return columns
    weighted = (columns * image.precision[..., None]).movedim(-1, 0)
    absorbed = image.field.expand(image.system.solve(image.field.project(weighted)))
    return columns - absorbed.movedim(0, -1)


def normal_equations(
    image: RobustImage, jacobian: Float[Tensor, "h w parameter"]
) -> tuple[Float[Tensor, "parameter parameter"], Float[Tensor, " parameter"]]:
    """A^T W A and A^T W r of eq. 12 with the full noise covariance."""
    used = torch.nonzero(image.precision.flatten() > 0)[:, 0]
    reduced = reduced_jacobian(image, jacobian).flatten(0, 1)[used]
    weighted = reduced * image.precision.flatten()[used, None]
    information = weighted.mT @ jacobian.flatten(0, 1)[used].double()
    return 0.5 * (information + information.mT), weighted.mT @ image.error.flatten()[used]


def blockwise_scatter(
    image: RobustImage, jacobian: Float[Tensor, "h w parameter"], side: int
) -> Float[Tensor, "parameter parameter"]:
    """Sum over blocks of g g^T, g a block's part of the gradient: the middle of the sandwich.

    For right noise it equals the information. Where neighbouring errors are alike in a way that the
    noise model does not know, it is larger by as much as the estimate really scatters.
    """
    share = reduced_jacobian(image, jacobian) * (image.precision * image.error)[..., None]
    height, width = image.error.shape
    rows = torch.arange(height, device=share.device) // side
    columns = torch.arange(width, device=share.device) // side
    block = rows[:, None] * (width // side + 1) + columns
    sums = share.new_zeros(int(block.max()) + 1, share.shape[-1])
    sums.index_add_(0, block.flatten(), share.flatten(0, 1))
    return sums.mT @ sums
