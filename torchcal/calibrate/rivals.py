"""Which other states explain the images as well: judged by the pixels in which they differ.

All pixels together would not do: an object that stands elsewhere changes few of them.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.range_fit import RangeFit
from torchcal.geometry import robust

RIVAL = 0.05
"""Share by which the robust cost of a rival may be higher: models are a little wrong everywhere."""
DECISIVE = 10.0
"""Difference of robust costs that noise does not reach: a likelihood ratio of 20,000."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Look:
    """The images against what one state predicts."""

    residual: Float[Tensor, "frame h w"]
    compared: Bool[Tensor, "frame h w"]
    rho: Float[Tensor, "frame h w"]
    """Robust cost of each measured pixel; what the model leaves empty is as one beyond c."""
    prior: Float[Tensor, ""]


def is_rival(
    fit: RangeFit, state: Float[Tensor, "slot 4 4"], best: Float[Tensor, "slot 4 4"]
) -> bool:
    """Whether a state is another answer: it explains the images as well, and is one of its own.

    Where the state halfway explains them too, both lie in one valley. What the images leave open
    along it is the covariance's to tell.

    Args:
        fit: The images.
        state: Another state.
        best: The state of the least cost.
    """
    halfway = fit.parameters.retract(best, 0.5 * fit.parameters.difference(state, best))
    return explains_as_well(fit, state, best) and not explains_as_well(fit, halfway, best)


def explains_as_well(
    fit: RangeFit, state: Float[Tensor, "slot 4 4"], best: Float[Tensor, "slot 4 4"]
) -> bool:
    """Whether a state explains the pixels in which it differs from the best as well as that does.

    Args:
        fit: The images.
        state: Another state.
        best: The state of the least cost.
    """
    other, least = _looked(fit, state), _looked(fit, best)
    sigma = fit.observation.sigma * fit.sigma_scale
    differ = (other.residual - least.residual).abs() > sigma
    differ = differ | (other.compared != least.compared)
    cost, allowed = (each.rho[differ].sum() + each.prior for each in (other, least))
    return bool(cost <= (1.0 + RIVAL) * allowed + DECISIVE)


def _looked(fit: RangeFit, state: Tensor) -> _Look:
    frames = list(fit.residuals(state))
    residual, compared, sigma, uncompared = (
        torch.stack([getattr(frame, name) for frame in frames])
        for name in ("residual", "compared", "sigma", "uncompared")
    )
    rho = robust.biweight_cost((residual / sigma).double(), fit.cutoff)
    parameters = fit.parameters
    off = parameters.from_nominal(state)
    return _Look(
        residual=residual,
        compared=compared,
        rho=torch.where(compared, rho, uncompared),
        prior=0.5 * off.square().sum(),
    )
