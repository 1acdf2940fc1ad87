"""Robust normal equations of one image whose noise has a slowly varying part (eq. 8 to 16).

The slowly varying part is eliminated: it is fitted together with the step (Schur complement), which
is the same as using the inverse of the full noise covariance for W of eq. 8.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
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
    """Normal equations of the coefficients at ``precision``."""


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
    cost = residual.new_zeros(())
    if field is not None:
        for _ in range(ROUNDS):
            # The precision that was factorised last stays: the information is then definite.
            precision = _precision(error, sigma, compared, cutoff)
            system = field.system(precision)
            coefficients = system.solve(field.project(precision * residual))
            error = residual - field.expand(coefficients)
        cost = 0.5 * field.precision * coefficients.square().sum()
    rho = torch.where(compared, robust.biweight_cost(error / sigma, cutoff), 0.0)
    return RobustImage(
        error=error,
        precision=precision,
        cost=cost + rho.sum(),
        field=field,
        coefficients=coefficients,
        system=system,
    )


def normal_equations(
    image: RobustImage, jacobian: Float[Tensor, "h w parameter"]
) -> tuple[Float[Tensor, "parameter parameter"], Float[Tensor, " parameter"]]:
    """A^T W A and A^T W r of eq. 12, where W is the inverse of the full noise covariance.

    Args:
        image: The image's residuals.
        jacobian: Derivative of the prediction (eq. 13); any finite number where not compared.
    """
    reduced, _ = _reduced(image, jacobian)
    precision = image.precision.flatten()
    used = torch.nonzero(precision > 0)[:, 0]
    columns, precision = jacobian.flatten(0, 1)[used].double(), precision[used]
    information = (reduced.flatten(0, 1)[used] * precision[:, None]).mT @ columns
    # W r is the precision times the error, so here the Jacobian must not be reduced again.
    gradient = columns.mT @ (precision * image.error.flatten()[used])
    return 0.5 * (information + information.mT), gradient


def blockwise_scatter(
    image: RobustImage, jacobian: Float[Tensor, "h w parameter"], side: int
) -> Float[Tensor, "parameter parameter"]:
    """Sum over blocks of g g^T, g a block's part of the gradient: the middle of the sandwich.

    For right noise it is near the information. Where neighbouring errors are alike in a way that
    the noise model does not know, it is larger by as much as the estimate really scatters.

    Args:
        image: The image's residuals.
        jacobian: Derivative of the prediction (eq. 13); any finite number where not compared.
        side: Of a block (pixels).
    """
    reduced, absorbed = _reduced(image, jacobian)
    share = reduced * (image.precision * image.error)[..., None]
    block = _blocks(image.error, side)
    sums = share.new_zeros(int(block.max()) + 1, share.shape[-1])
    sums.index_add_(0, block.flatten(), share.flatten(0, 1))
    if image.field is not None:
        v, u = image.field.peaks()
        pull = image.field.precision * image.coefficients
        sums.index_add_(0, block[v[:, None], u].flatten(), absorbed * pull[:, None])
    return sums.mT @ sums


def _reduced(image: RobustImage, jacobian: Tensor) -> tuple[Tensor, Tensor]:
    """The Jacobian as A = R + Phi B, B being what the slowly varying part could explain of it.

    B = M^-1 Phi^T W A, with the weights W of single pixels and M = Phi^T W Phi + prior.

    Returns:
        R (h w parameter); B (coefficient parameter).
    """
    columns = jacobian.double()
    if image.field is None or image.system is None:
        return columns, columns.new_zeros(0, columns.shape[-1])
    weighted = (columns * image.precision[..., None]).movedim(-1, 0)
    absorbed = image.system.solve(image.field.project(weighted))
    return columns - image.field.expand(absorbed).movedim(0, -1), absorbed.mT


def _blocks(like: Float[Tensor, "h w"], side: int) -> Int[Tensor, "h w"]:
    """The number of the square block that each pixel lies in."""
    height, width = like.shape
    rows = torch.arange(height, device=like.device) // side
    columns = torch.arange(width, device=like.device) // side
    return rows[:, None] * (width // side + 1) + columns


def _precision(error: Tensor, sigma: Tensor, compared: Tensor, cutoff: float) -> Tensor:
    return torch.where(compared, robust.biweight(error / sigma, cutoff) / sigma.square(), 0.0)
