"""Which other states explain the images as well: judged by the pixels in which they differ.

All pixels together would not do: an object that stands elsewhere changes few of them.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.range_fit import FrameResidual, RangeFit
from torchcal.geometry import robust

RIVAL = 0.05
"""Share by which the robust cost of a rival may be higher: models are a little wrong everywhere."""
DECISIVE = 10.0
"""Difference of robust costs that noise does not reach: a likelihood ratio of 20,000."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Look:
    """The images against what one state predicts."""

    state: Float[Tensor, "slot 4 4"]
    residual: Float[Tensor, "frame h w"]
    compared: Bool[Tensor, "frame h w"]
    rho: Float[Tensor, "frame h w"]
    """Robust cost of each measured pixel; what the model leaves empty is as one beyond c."""
    prior: Float[Tensor, ""]

    @staticmethod
    def of(fit: RangeFit, state: Float[Tensor, "slot 4 4"]) -> "Look":
        """Predicts all images, without keeping their derivatives: they would fill the memory."""
        frames = [(f.residual, f.compared, _costs(f, fit.cutoff)) for f in fit.residuals(state)]
        residual, compared, rho = (torch.stack(images) for images in zip(*frames, strict=True))
        return Look(
            state=state,
            residual=residual,
            compared=compared,
            rho=rho,
            prior=0.5 * fit.parameters.from_nominal(state).square().sum(),
        )


def is_rival(fit: RangeFit, state: Float[Tensor, "slot 4 4"], best: Look) -> bool:
    """Whether a state is another answer: it explains the images as well, and is one of its own.

    Where the state halfway explains them too, both lie in one valley. What the images leave open
    along it is the covariance's to tell.

    Args:
        fit: The images.
        state: Another state.
        best: A look at the state of the least cost.
    """
    step = 0.5 * fit.parameters.difference(state, best.state)
    halfway = fit.parameters.retract(best.state, step)
    return explains_as_well(fit, state, best) and not explains_as_well(fit, halfway, best)


def explains_as_well(fit: RangeFit, state: Float[Tensor, "slot 4 4"], best: Look) -> bool:
    """Whether a state explains the pixels in which it differs from the best as well as that does.

    Args:
        fit: The images.
        state: Another state.
        best: A look at the state of the least cost.
    """
    other = Look.of(fit, state)
    sigma = fit.observation.sigma * fit.sigma_scale
    differ = (other.residual - best.residual).abs() > sigma
    differ = differ | (other.compared != best.compared)
    cost, allowed = (each.rho[differ].sum() + each.prior for each in (other, best))
    return bool(cost <= (1.0 + RIVAL) * allowed + DECISIVE)


def _costs(frame: FrameResidual, cutoff: float) -> Float[Tensor, "h w"]:
    rho = robust.biweight_cost((frame.residual / frame.sigma).double(), cutoff)
    return torch.where(frame.compared, rho, frame.uncompared)
