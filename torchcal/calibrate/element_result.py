"""What is known of poses that were found from elements."""

from dataclasses import dataclass, replace
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry import robust, se3
from torchcal.match.minimal_sets import Hypotheses
from torchcal.match.support import are_new
from torchcal.solve.gauss_newton import covariance

OTHER = 5.0
"""Standard deviations beyond which a pose is another one."""
MISFIT = 6.0
"""Standard deviations of the sum of squares beyond which residuals are not noise."""


class ElementStatus(IntEnum):
    """What is to be thought of one pose."""

    CONVERGED = 0
    AMBIGUOUS = 1
    """Another pose explains as many elements, as many of them among the candidates."""
    UNOBSERVABLE = 2
    """The elements do not determine all of the pose."""
    FAILED = 3
    """No pose explains enough elements, with residuals that noise could give."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ElementPoses:
    """Poses of a batch of problems, what they rest on, and their rivals."""

    T_measured_model: Float[Tensor, "*batch 4 4"]
    """Carries the model's elements onto the measured ones; NaN where no pose was found."""
    covariance: Float[Tensor, "*batch 6 6"]
    """Of a twist on the right of the pose (m, rad); NaN where it is not observable."""
    rank: Int[Tensor, "*batch"]
    """How many of the six directions of the twist the correspondences determine."""
    status: Int[Tensor, "*batch"]
    """One ``ElementStatus`` each."""
    partner: Int[Tensor, "*batch model"]
    """The measured element that belongs to each of the model's."""
    weights: Float[Tensor, "*batch model component"]
    """Biweights of these correspondences; all 0 where an element of the model has no partner."""
    cost: Float[Tensor, "*batch"]
    """The sum of rho."""
    explained: Int[Tensor, "*batch"]
    """Distinct measured elements that keep their weight."""
    supported: Int[Tensor, "*batch"]
    """How many of them were candidates."""
    iterations: Int[Tensor, "*batch"]
    """Steps of nonlinear least squares that led to the pose."""
    searches: Int[Tensor, "*batch"]
    """Searches of initial values: 1 where the first was good."""
    rivals: Hypotheses
    """Other poses that explain as many elements, as a list over the flattened batch."""
    rivals_supported: Int[Tensor, " rival"]
    """How many of theirs were candidates."""
    from_candidates: Hypotheses
    """The poses that most candidates support, before the correspondences are detected again."""

    def moved_back(
        self, model: Float[Tensor, "problem 3"], measured: Float[Tensor, "problem 3"]
    ) -> "ElementPoses":
        """The same for elements that are not about these centres (m); of one batch axis."""

        def listed(poses: Hypotheses) -> Hypotheses:
            T = _moved_back(poses.T, model[poses.batch], measured[poses.batch])
            return Hypotheses(batch=poses.batch, T=T)

        moved = se3.adjoint(_translation(model))
        return replace(
            self,
            T_measured_model=_moved_back(self.T_measured_model, model, measured),
            covariance=moved @ self.covariance @ moved.mT,
            rivals=listed(self.rivals),
            from_candidates=listed(self.from_candidates),
        )


def _moved_back(T: Tensor, model: Tensor, measured: Tensor) -> Tensor:
    return _translation(measured) @ T @ _translation(-model)


def _translation(t: Tensor) -> Tensor:
    eye = torch.eye(3, dtype=t.dtype, device=t.device).expand(*t.shape, 3)
    return se3.from_rotation_translation(eye, t)


class TriedPoses(NamedTuple):
    """Fitted hypotheses of many problems; every tensor has a row for each.

    The names are those of ``ElementPoses``.
    """

    problem: Tensor
    T: Tensor
    explained: Tensor
    supported: Tensor
    cost: Tensor
    misfit: Tensor
    fingerprint: Tensor
    """The same for the same pose."""
    partner: Tensor
    kept: Tensor
    """Which elements of the model are explained."""
    weights: Tensor
    information: Tensor
    cutoff: Tensor
    iterations: Tensor

    def rows(self, chosen: Tensor) -> "TriedPoses":
        """Some of the hypotheses."""
        return TriedPoses(*(values[chosen] for values in self))

    def is_good(self, enough: float) -> Tensor:
        """Whether enough elements are explained, with residuals that noise could give."""
        return (self.explained >= enough) & (self.misfit <= MISFIT)

    def score(self) -> Tensor:
        """Elements explained first, candidates among them second."""
        return self.explained * (self.partner.shape[1] + 1) + self.supported

    def best(self) -> Tensor:
        """For every problem the row with the highest score and, among those, the lowest cost."""
        order = self.cost.argsort(stable=True)
        order = order[self.score()[order].argsort(descending=True, stable=True)]
        order = order[self.problem[order].argsort(stable=True)]
        is_first = torch.ones_like(order, dtype=torch.bool)
        is_first[1:] = self.problem[order].diff() > 0
        return order[is_first]

    @staticmethod
    def join(*parts: "TriedPoses") -> "TriedPoses":
        """All hypotheses of several sets."""
        return TriedPoses(*(torch.cat(values) for values in zip(*parts, strict=True)))


def conclude(tried: TriedPoses, searches: Tensor, first: Hypotheses, enough: float) -> ElementPoses:
    """The best pose of every problem, what it rests on, and its rivals.

    Args:
        tried: All fitted hypotheses, at least one for every problem.
        searches: Searches of initial values for every problem.
        first: The poses that most candidates support, before the detection among all.
        enough: Elements that a good estimate explains.
    """
    best_rows = tried.best()
    best = tried.rows(best_rows)
    rivals = _rivals(tried, best)
    rank = _rank(best.information)
    equal = rivals.supported == best.supported[rivals.problem]
    is_ambiguous = torch.zeros_like(searches, dtype=torch.bool)
    is_ambiguous[rivals.problem[equal]] = True
    status = torch.full_like(searches, ElementStatus.CONVERGED.value)
    status = torch.where(is_ambiguous, ElementStatus.AMBIGUOUS.value, status)
    status = torch.where(rank < 6, ElementStatus.UNOBSERVABLE.value, status)
    status = torch.where(best.is_good(enough), status, ElementStatus.FAILED.value)
    inflation = robust.variance_inflation(best.cutoff)[:, None, None]
    return ElementPoses(
        T_measured_model=best.T,
        covariance=inflation * covariance(best.information),
        rank=rank,
        status=status,
        partner=best.partner,
        weights=best.weights,
        cost=best.cost,
        explained=best.explained,
        supported=best.supported,
        iterations=best.iterations,
        searches=searches,
        rivals=Hypotheses(batch=rivals.problem, T=rivals.T),
        rivals_supported=rivals.supported,
        from_candidates=first,
    )


def _rivals(tried: TriedPoses, best: TriedPoses) -> TriedPoses:
    """Other poses that explain as many elements, each of them once."""
    own = best.rows(tried.problem)
    as_good = (tried.explained == own.explained) & (tried.explained > 0)
    rivals, own = tried.rows(as_good), own.rows(as_good)
    xi = se3.log(se3.inverse(own.T) @ rivals.T)
    squared = (xi * (own.information @ xi[..., None])[..., 0]).sum(-1)
    rivals = rivals.rows(squared > OTHER**2)
    return rivals.rows(are_new(rivals.problem, rivals.fingerprint))


def _rank(information: Tensor) -> Tensor:
    """Directions of the twist that are determined, in units in which each axis alone counts 1."""
    scale = information.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    scaled = information * scale[..., :, None] * scale[..., None, :]
    scaled = torch.where(scaled.isfinite().all(-1, keepdim=True), scaled, 0.0)
    least = 100 * torch.finfo(information.dtype).eps
    return (torch.linalg.eigvalsh(scaled) > least).sum(-1)


def joined(parts: list[ElementPoses], batch: torch.Size) -> ElementPoses:
    """Chunks of a batch one after the other, in the batch's own shape."""
    offsets = [0]
    for part in parts:
        offsets.append(offsets[-1] + len(part.status))

    def whole(name: str) -> Tensor:
        values = torch.cat([getattr(part, name) for part in parts])
        return values.reshape((*batch, *values.shape[1:]))

    def listed(name: str) -> Hypotheses:
        chosen = [getattr(part, name) for part in parts]
        shifted = [h.batch + offset for h, offset in zip(chosen, offsets, strict=False)]
        return Hypotheses(batch=torch.cat(shifted), T=torch.cat([h.T for h in chosen]))

    return ElementPoses(
        T_measured_model=whole("T_measured_model"),
        covariance=whole("covariance"),
        rank=whole("rank"),
        status=whole("status"),
        partner=whole("partner"),
        weights=whole("weights"),
        cost=whole("cost"),
        explained=whole("explained"),
        supported=whole("supported"),
        iterations=whole("iterations"),
        searches=whole("searches"),
        rivals=listed("rivals"),
        rivals_supported=torch.cat([part.rivals_supported for part in parts]),
        from_candidates=listed("from_candidates"),
    )
