"""What one image adds to what was believed, and whether both can be right (P of eq. 3)."""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from scipy.stats import chi2
from torch import Tensor

TOLD = 1e-3
"""An image that tells less than this part of what might have happened says nothing in that
direction: the square of that standard deviation over the image's own."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Innovation:
    """A belief after an image."""

    step: Float[Tensor, " parameter"]
    """From the state that was expected."""
    covariance: Float[Tensor, "parameter parameter"]
    p_value: float
    """How often chance alone would make image and expectation differ as much; 1 if nothing is
    told."""


def innovation(
    expected: Float[Tensor, "parameter parameter"],
    information: Float[Tensor, "parameter parameter"],
    score: Float[Tensor, " parameter"],
    possible: Float[Tensor, " parameter"],
) -> Innovation:
    """Joins an expectation with what an image tells, both Gaussian.

    The score of the image at the expected state is normal with covariance I P I + I, where P is
    the expectation's covariance and I the image's information.

    Args:
        expected: Covariance of the parameters before the image.
        information: What the image tells of them (A^T W A).
        score: The image's gradient at the expected state (A^T W r).
        possible: Standard deviations of what may have happened, not below those of what is
            expected: what an image tells is measured against them, since an image that adds nothing
            to what is believed may still contradict it.
    """
    scale = expected.diagonal().clamp(min=1e-300).sqrt()  # metres and radians become alike
    P = expected / scale[:, None] / scale
    told, pull = information * scale[:, None] * scale, score * scale
    root = _root(P)
    inner = torch.eye(len(P)).to(P) + root.mT @ told @ root
    value, vector = torch.linalg.eigh(inner)  # not below 1: what is believed only gets surer
    half = root @ vector * value.clamp(min=1.0).rsqrt()
    after = half @ half.mT
    return Innovation(
        step=scale * (after @ pull),
        covariance=after * scale[:, None] * scale,
        p_value=_p_value(expected, information, score, possible),
    )


def _root(P: Tensor) -> Tensor:
    """R with R R^T = P, for covariances that are singular, too."""
    value, vector = torch.linalg.eigh(0.5 * (P + P.mT))
    return vector * value.clamp(min=0.0).sqrt()


def _p_value(P: Tensor, information: Tensor, score: Tensor, possible: Tensor) -> float:
    """Chi-square test of the score, in the directions in which the image tells something."""
    told = information * possible[:, None] * possible
    value, vector = torch.linalg.eigh(told)
    kept = value > TOLD
    if not kept.any():
        return 1.0
    value, vector = value[kept], vector[:, kept]
    # In units of the image's own sigmas: large information would spoil the digits.
    seen = (vector.mT @ (score * possible)) / value.sqrt()
    spread = vector * value.sqrt()
    S = spread.mT @ (P / possible[:, None] / possible) @ spread + torch.eye(len(value)).to(P)
    distance = float(seen @ torch.linalg.solve(S, seen))
    return float(chi2.sf(distance, len(value)))
