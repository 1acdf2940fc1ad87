"""Robust normal equations of lists of correspondences (eq. 9 to 16 and 3.5 (4))."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry import robust
from torchcal.solve.gauss_newton import NormalEquations
from torchcal.solve.jacobian import Linearise


@dataclass(frozen=True, kw_only=True, slots=True)
class RobustCorrespondences:
    """A batch of problems whose residuals come in correspondences of several components."""

    linearise: Linearise
    """Whitened residuals and derivatives of some of the problems."""
    present: Bool[Tensor, "problem correspondence component"]
    """Components that there are; the others are padding."""
    cutoff: Float[Tensor, " problem"]
    """c of eq. 16, in standard deviations."""

    def evaluate(self, state: Tensor, problem: Int[Tensor, " active"]) -> NormalEquations:
        """Normal equations of some of the problems."""
        v, A = self.linearise(state, problem)
        present, c = self.present[problem], self.cutoff[problem, None, None]
        v = torch.where(present, v, 0.0)
        weight = _weights(v, present, c)
        A = torch.where(present[..., None], A, 0.0).flatten(1, 2)
        weighted = A * weight.flatten(1)[..., None]
        return NormalEquations(
            cost=_costs(v, present, c),
            information=weighted.mT @ A,
            gradient=(weighted.mT @ v.flatten(1)[..., None])[..., 0],
        )

    def weights(
        self, v: Float[Tensor, "problem correspondence component"]
    ) -> Float[Tensor, "problem correspondence component"]:
        """The biweights of whitened residuals; 0 for padding."""
        v = torch.where(self.present, v, 0.0)
        return _weights(v, self.present, self.cutoff[:, None, None])

    def costs(
        self, v: Float[Tensor, "problem correspondence component"]
    ) -> Float[Tensor, " problem"]:
        """The sums of rho of whitened residuals."""
        v = torch.where(self.present, v, 0.0)
        return _costs(v, self.present, self.cutoff[:, None, None])


def _weights(v: Tensor, present: Tensor, c: Tensor) -> Tensor:
    return torch.where(present & _kept(v, c), robust.biweight(v, c), 0.0)


def _costs(v: Tensor, present: Tensor, c: Tensor) -> Tensor:
    rho = torch.where(_kept(v, c), robust.biweight_cost(v, c), robust.rejected_cost(c))
    return torch.where(present, rho, 0.0).flatten(1).sum(1)


def _kept(v: Tensor, c: Tensor) -> Tensor:
    """3.5 (4): when one component of a correspondence loses its weight, all of them do."""
    return (v.abs() < c).all(-1, keepdim=True)
