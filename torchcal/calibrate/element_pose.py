"""The pose of measured elements without a starting value: hypotheses, procedure 3.5, restarts."""

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.calibrate.element_fit import (
    COARSE,
    ElementFit,
    ElementProblem,
    procedure_3_5,
    start_cutoff,
)
from torchcal.geometry import robust
from torchcal.match.detection import Detect, every_candidate, nearest_candidate
from torchcal.match.elements import Elements
from torchcal.match.minimal_sets import Hypotheses, minimal_hypotheses
from torchcal.match.random_starts import random_starts
from torchcal.match.support import are_best, are_new, distinct, squared_errors
from torchcal.solve.gauss_newton import covariance

GATE = robust.ZETA * robust.EFFICIENT
"""Standard deviations within which a hypothesis explains an element: zeta steers the search, since
a pose from a minimal set carries the noise of its few elements."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ElementSearch:
    """Settings of the search for a pose."""

    sets: int = 1000
    """Most minimal sets of candidates for each problem; more are sampled."""
    restarts: int = 4
    """Most repetitions of the search where good estimation cannot be obtained: the first among all
    pairs of elements, C ignored, the others from random poses."""
    starts: int = 64
    """Random poses in each of those."""
    enough: float = 0.75
    """Share of the measured elements that a good estimate explains."""
    least_cutoff: float = robust.EFFICIENT
    """Where c of eq. 16 stops shrinking in the last fit; 0 for the literal equation."""
    chunk: int = 2000
    """Problems that are solved at a time: it bounds the memory."""


class ElementStatus(IntEnum):
    """What is to be thought of one pose."""

    CONVERGED = 0
    AMBIGUOUS = 1
    """Another pose explains as many elements, as many of them among the candidates."""
    UNOBSERVABLE = 2
    """The elements do not determine all of the pose."""
    FAILED = 3
    """No pose explains as much as a good estimate does."""


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
    """Distinct measured elements that the pose explains."""
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


def find_element_poses(
    model: Elements,
    measured: Elements,
    candidates: Bool[Tensor, "*batch model measured"],
    *,
    generator: torch.Generator,
    search: ElementSearch | None = None,
    detect: Detect = every_candidate,
) -> ElementPoses:
    """Finds poses from uncertain correspondences: hypotheses, procedure 3.5, re-detection, restarts.

    Args:
        model: Elements of the model, for all problems or for each.
        measured: Measured elements of each problem, with their covariances.
        candidates: The matrix C of eq. 6.
        generator: For samples and random starts.
        search: Settings; None for the defaults.
        detect: Step (1) of 3.5: ``every_candidate`` or ``nearest_candidate``.

    Raises:
        ValueError: If the shapes do not belong together.
    """
    search = search or ElementSearch()
    _check(model, measured, candidates)
    batch = candidates.shape[:-2]
    model, measured = model.expand(*batch).flattened(), measured.expand(*batch).flattened()
    flat = candidates.reshape(-1, *candidates.shape[-2:])
    parts = []
    for first in range(0, len(flat), search.chunk):
        rows = slice(first, first + search.chunk)
        problem = ElementProblem.of(model[rows], measured[rows], flat[rows])
        parts.append(_find(problem, search, detect, generator))
    return _joined(parts, batch)


class _Tried(NamedTuple):
    """Fitted hypotheses of many problems; every tensor has a row for each."""

    problem: Tensor
    T: Tensor
    explained: Tensor
    supported: Tensor
    cost: Tensor
    partner: Tensor
    weights: Tensor
    information: Tensor
    cutoff: Tensor
    iterations: Tensor

    def rows(self, chosen: Tensor) -> "_Tried":
        return _Tried(*(values[chosen] for values in self))

    def score(self) -> Tensor:
        """Elements explained first, candidates among them second."""
        return self.explained * (self.partner.shape[1] + 1) + self.supported

    @staticmethod
    def join(*parts: "_Tried") -> "_Tried":
        return _Tried(*(torch.cat(values) for values in zip(*parts, strict=True)))

    @staticmethod
    def nothing(problem: ElementProblem) -> "_Tried":
        """What there is for every problem before anything was tried: no pose."""
        members, count = problem.model.kind.shape
        number = torch.arange(members, device=problem.model.kind.device)
        empty = problem.measured.point.new_zeros
        present = problem.whitening.present
        return _Tried(
            problem=number,
            T=empty(members, 4, 4) + torch.nan,
            explained=torch.full_like(number, -1),
            supported=torch.full_like(number, -1),
            cost=empty(members) + torch.inf,
            partner=number.new_zeros(members, count),
            weights=empty(members, count, present.shape[-1]),
            information=empty(members, 6, 6),
            cutoff=empty(members) + robust.EFFICIENT,
            iterations=torch.zeros_like(number),
        )


def _find(
    problem: ElementProblem, search: ElementSearch, detect: Detect, generator: torch.Generator
) -> ElementPoses:
    """All of the search for one chunk of problems."""
    members = len(problem.candidates)
    enough = search.enough * problem.measured.count
    starts = _hypotheses(problem, search, generator)
    first, tried = _attempt(problem, starts, search, detect)
    tried = _Tried.join(_Tried.nothing(problem), tried)
    searches = torch.ones(members, dtype=torch.int64, device=tried.problem.device)
    for restart in range(search.restarts):
        best = tried.rows(_best_rows(tried))
        weak = (best.explained < enough).nonzero()[:, 0]
        if len(weak) == 0:
            break
        again = _restarted(problem.rows(weak), restart, search, generator)
        tried = _Tried.join(tried, again._replace(problem=weak[again.problem]))
        searches[weak] += 1
    return _result(tried, searches, first, enough)


def _hypotheses(
    problem: ElementProblem, search: ElementSearch, generator: torch.Generator
) -> Hypotheses:
    return minimal_hypotheses(
        problem.model,
        problem.measured,
        problem.candidates,
        limit=search.sets,
        generator=generator,
    )


def _restarted(
    problem: ElementProblem, restart: int, search: ElementSearch, generator: torch.Generator
) -> _Tried:
    """The random search of initial values: C ignored first, then from anywhere."""
    everything = problem.with_every_pair()
    if restart == 0:
        starts = _hypotheses(everything, search, generator)
        _, tried = _attempt(everything, starts, search, nearest_candidate)
    else:
        starts = random_starts(
            problem.model, problem.measured, search.starts, generator=generator
        )
        cutoff = start_cutoff(everything, starts, nearest_candidate)
        fit = procedure_3_5(everything, starts, cutoff, detect=nearest_candidate, steps=COARSE)
        tried = _detected_again(everything, fit, search)
    return tried._replace(supported=_support(problem, tried))


def _attempt(
    problem: ElementProblem, starts: Hypotheses, search: ElementSearch, detect: Detect
) -> tuple[Hypotheses, _Tried]:
    """The best hypotheses, fitted to the candidates and then to all that is detected again.

    Returns:
        The poses that most candidates support; all poses after the detection.
    """
    starts = starts[_worth_fitting(problem, starts)]
    cutoff = torch.full_like(starts.T[:, 0, 0], GATE)
    fit = procedure_3_5(problem, starts, cutoff, detect=detect, steps=COARSE)
    near = _near(problem, fit.poses)
    supported = distinct(near & problem.candidates[starts.batch])
    best = are_best(starts.batch, supported, len(problem.candidates))
    best = best & are_new(starts.batch, near)
    return fit.poses[best], _detected_again(problem, fit, search)


def _worth_fitting(problem: ElementProblem, starts: Hypotheses) -> Tensor:
    """One hypothesis for each pose that explains the most, with the candidates or with all."""
    near = _near(problem, starts)
    members = len(problem.candidates)
    supported = distinct(near & problem.candidates[starts.batch])
    score = distinct(near) * (problem.model.count + 1) + supported
    best = are_best(starts.batch, supported, members) | are_best(starts.batch, score, members)
    rows = best.nonzero()[:, 0]
    return rows[are_new(starts.batch[rows], near[rows])]


def _near(problem: ElementProblem, poses: Hypotheses) -> Tensor:
    """The pairs that a pose explains, candidates or not."""
    return squared_errors(poses, problem.model, problem.measured) <= GATE**2


def _support(problem: ElementProblem, tried: _Tried) -> Tensor:
    """How many of the pairs that each pose explains are candidates."""
    poses = Hypotheses(batch=tried.problem, T=tried.T)
    return distinct(_near(problem, poses) & problem.candidates[tried.problem])


def _detected_again(
    problem: ElementProblem, before: ElementFit, search: ElementSearch
) -> _Tried:
    """Correspondences detected anew among all pairs, C ignored, and the last fit (3.5 (1))."""
    everything = problem.with_every_pair()
    cutoff = torch.full_like(before.cost, GATE)
    fit = procedure_3_5(
        everything,
        before.poses,
        cutoff,
        detect=nearest_candidate,
        least=search.least_cutoff,
    )
    near = _near(problem, fit.poses)
    return _Tried(
        problem=fit.poses.batch,
        T=fit.poses.T,
        explained=distinct(near),
        supported=distinct(near & problem.candidates[fit.poses.batch]),
        cost=fit.cost,
        partner=fit.pairs.measured,
        weights=fit.weights,
        information=fit.information,
        cutoff=fit.cutoff,
        iterations=before.iterations + fit.iterations,
    )


def _best_rows(tried: _Tried) -> Tensor:
    """For every problem the row with the highest score and, among those, the lowest cost."""
    order = tried.cost.argsort(stable=True)
    order = order[tried.score()[order].argsort(descending=True, stable=True)]
    order = order[tried.problem[order].argsort(stable=True)]
    is_first = torch.ones_like(order, dtype=torch.bool)
    is_first[1:] = tried.problem[order].diff() > 0
    return order[is_first]


def _result(
    tried: _Tried, searches: Tensor, first: Hypotheses, enough: float
) -> ElementPoses:
    best_rows = _best_rows(tried)
    best = tried.rows(best_rows)
    rival = (tried.explained == best.explained[tried.problem]) & (tried.explained > 0)
    rival[best_rows] = False
    rivals = tried.rows(rival)
    rank = _rank(best.information)
    equal = rivals.supported == best.supported[rivals.problem]
    is_ambiguous = torch.zeros_like(searches, dtype=torch.bool)
    is_ambiguous[rivals.problem[equal]] = True
    status = torch.full_like(searches, ElementStatus.CONVERGED.value)
    status = torch.where(is_ambiguous, ElementStatus.AMBIGUOUS.value, status)
    status = torch.where(rank < 6, ElementStatus.UNOBSERVABLE.value, status)
    status = torch.where(best.explained < enough, ElementStatus.FAILED.value, status)
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


def _rank(information: Tensor) -> Tensor:
    """Directions of the twist that are determined, in units in which each axis alone counts 1."""
    scale = information.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    scaled = information * scale[..., :, None] * scale[..., None, :]
    scaled = torch.where(scaled.isfinite().all(-1, keepdim=True), scaled, 0.0)
    least = 100 * torch.finfo(information.dtype).eps
    return (torch.linalg.eigvalsh(scaled) > least).sum(-1)


def _check(model: Elements, measured: Elements, candidates: Tensor) -> None:
    found = tuple(candidates.shape[-2:])
    expected = (model.count, measured.count)
    if found != expected:
        raise ValueError(
            f"candidates have the shape {found} (model, measured) for {expected[0]} elements of "
            f"the model and {expected[1]} measured ones"
        )


def _joined(parts: list[ElementPoses], batch: torch.Size) -> ElementPoses:
    """Chunks one after the other, in the batch's own shape."""
    offsets = [0]
    for part in parts:
        offsets.append(offsets[-1] + len(part.status))

    def whole(name: str) -> Tensor:
        values = torch.cat([getattr(part, name) for part in parts])
        return values.reshape(*batch, *values.shape[1:])

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
