"""Gaussian uncertainty: propagation and what a prior is told by data."""

import torch
from jaxtyping import Float
from torch import Tensor


def predicted_sigma(
    H: Float[Tensor, "*batch parameter"],
    P: Float[Tensor, "parameter parameter"],
    sigma: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch"]:
    """Standard deviation of measured minus predicted: sigma' = sqrt(H P H^T + sigma^2) (eq. 4).

    Args:
        H: Derivative of the prediction to the parameters.
        P: Covariance of the parameters (eq. 3).
        sigma: Noise of the measurement, in the unit of the result.
    """
    variance = ((H @ P) * H).sum(-1)
    return (variance.clamp(min=0.0) + sigma.square()).sqrt()


def moved_covariance(
    P: Float[Tensor, "parameter parameter"], J: Float[Tensor, "*batch 6 parameter"]
) -> Float[Tensor, "*batch 6 6"]:
    """J P J^T, the covariance of a twist that depends on the parameters by J."""
    return J @ P @ J.mT


def left_over(
    covariance: Float[Tensor, "n n"], prior_sigma: Float[Tensor, " n"]
) -> tuple[Float[Tensor, " n"], Float[Tensor, "n n"]]:
    """How much of the prior's standard deviation the data leave, by direction.

    Args:
        covariance: Of the parameters after the data.
        prior_sigma: Standard deviations before the data.

    Returns:
        Ratios, 1 where the data say nothing, in falling order; the directions, in units of the
        prior's sigmas, as columns of length 1. NaN if the covariance is not finite.
    """
    scaled = covariance / prior_sigma[:, None] / prior_sigma
    if not scaled.isfinite().all():
        return torch.full_like(prior_sigma, torch.nan), torch.full_like(scaled, torch.nan)
    ratio, direction = torch.linalg.eigh(0.5 * (scaled + scaled.mT))
    return ratio.clamp(min=0.0).sqrt().flip(0), direction.flip(1)
