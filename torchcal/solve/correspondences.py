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
        kept = _kept(v, c)
        weight = torch.where(present & kept, robust.biweight(v, c), 0.0)
        A = torch.where(present[..., None], A, 0.0).flatten(1, 2)
        weighted = A * weight.flatten(1)[..., None]
        rho = torch.where(kept, robust.biweight_cost(v, c), c.square() / 6.0)
        return NormalEquations(
            cost=torch.where(present, rho, 0.0).flatten(1).sum(1),
            information=weighted.mT @ A,
            gradient=(weighted.mT @ v.flatten(1)[..., None])[..., 0],
        )

    def weights(
        self, v: Float[Tensor, "problem correspondence component"]
    ) -> Float[Tensor, "problem correspondence component"]:
        """The biweights of whitened residuals; 0 for padding."""
        v, c = torch.where(self.present, v, 0.0), self.cutoff[:, None, None]
        return torch.where(self.present & _kept(v, c), robust.biweight(v, c), 0.0)


def _kept(v: Tensor, c: Tensor) -> Tensor:
    """3.5 (4): when one component of a correspondence loses its weight, all of them do."""
    return (v.abs() < c).all(-1, keepdim=True)
