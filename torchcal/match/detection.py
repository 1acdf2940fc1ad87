"""Step (1) of procedure 3.5: which measured element belongs to which of the model's at a pose."""

import math
from collections.abc import Callable
from typing import TypeAlias

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.match.pairs import Pairs

Detect: TypeAlias = Callable[[Tensor, Tensor, Tensor], Pairs]
"""Pairs of each hypothesis from its standard errors, the candidates and the cut-off."""

CORNER = math.sqrt(3.0)
"""A point of which no component is beyond the cut-off is at most this many cut-offs away."""


def every_candidate(
    error: Float[Tensor, "hypothesis model measured"],
    candidates: Bool[Tensor, "hypothesis model measured"],
    cutoff: Float[Tensor, " hypothesis"],
) -> Pairs:
    """All candidates that have not lost their weight, so an element may be in several pairs.

    Args:
        error: Of each pair, in standard deviations.
        candidates: The matrix C of eq. 6.
        cutoff: c of eq. 16.
    """
    near = error <= CORNER * cutoff[:, None, None]
    return Pairs.of(candidates & near & error.isfinite())


def nearest_candidate(
    error: Float[Tensor, "hypothesis model measured"],
    candidates: Bool[Tensor, "hypothesis model measured"],
    cutoff: Float[Tensor, " hypothesis"],
) -> Pairs:
    """The nearest candidate of every element of the model, and not beyond the cut-off.

    Args:
        error: Of each pair, in standard deviations.
        candidates: The matrix C of eq. 6.
        cutoff: c of eq. 16.
    """
    if error.shape[2] == 0:
        return Pairs.of(candidates)
    allowed = torch.where(candidates, error, torch.inf)
    distance, measured = allowed.min(-1)
    model = torch.arange(error.shape[1], device=error.device).expand_as(measured)
    near = (distance <= CORNER * cutoff[:, None]) & distance.isfinite()
    return Pairs(model=model, measured=measured, valid=near)
