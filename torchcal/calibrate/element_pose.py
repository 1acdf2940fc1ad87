"""The pose of measured elements without a starting value: hypotheses, procedure 3.5, restarts."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool
from torch import Tensor

from torchcal.calibrate.element_fit import (
    COARSE,
    ElementFit,
    ElementProblem,
    correspondences,
    procedure_3_5,
    start_cutoff,
)
from torchcal.calibrate.element_result import ElementPoses, TriedPoses, conclude, joined
from torchcal.geometry import robust
from torchcal.match.detection import Detect, every_candidate, nearest_candidate
from torchcal.match.elements import Elements
from torchcal.match.minimal_sets import Hypotheses, minimal_hypotheses
from torchcal.match.random_starts import random_starts
from torchcal.match.support import are_best, are_new, distinct, explained

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


def find_element_poses(
    model: Elements,
    measured: Elements,
    candidates: Bool[Tensor, "*batch model measured"],
    *,
    generator: torch.Generator,
    search: ElementSearch | None = None,
    detect: Detect = every_candidate,
) -> ElementPoses:
    """Finds poses from uncertain pairs: hypotheses, procedure 3.5, re-detection, restarts.

    Args:
        model: Elements of the model, for all problems or for each.
        measured: Measured elements of each problem, with their covariances.
        candidates: The matrix C of eq. 6.
        generator: For samples and random starts.
        search: Settings; None for the defaults.
        detect: Step (1) of 3.5: ``every_candidate`` or ``nearest_candidate``.

    Raises:
        ValueError: If shapes or dtypes do not belong together, or measured elements are exact.
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
    return joined(parts, batch)


def _find(
    problem: ElementProblem, search: ElementSearch, detect: Detect, generator: torch.Generator
) -> ElementPoses:
    """All of the search for one chunk of problems."""
    members = len(problem.candidates)
    enough = search.enough * problem.measured.count
    starts = _hypotheses(problem, search, generator)
    first, tried = _attempt(problem, starts, search, detect)
    tried = TriedPoses.join(_nothing(problem), tried)
    searches = torch.ones(members, dtype=torch.int64, device=tried.problem.device)
    for restart in range(search.restarts):
        best = tried.rows(tried.best())
        weak = (best.explained < enough).nonzero()[:, 0]
        if len(weak) == 0:
            break
        again = _restarted(problem.rows(weak), restart, search, generator)
        tried = TriedPoses.join(tried, again._replace(problem=weak[again.problem]))
        searches[weak] += 1
    return conclude(tried, searches, first, enough)


def _nothing(problem: ElementProblem) -> TriedPoses:
    """What there is for every problem before anything was tried: no pose."""
    members, count = problem.model.kind.shape
    number = torch.arange(members, device=problem.model.kind.device)
    empty = problem.measured.point.new_zeros
    return TriedPoses(
        problem=number,
        T=empty(members, 4, 4) + torch.nan,
        explained=torch.full_like(number, -1),
        supported=torch.full_like(number, -1),
        cost=empty(members) + torch.inf,
        partner=number.new_zeros(members, count),
        weights=empty(members, count, problem.whitening.present.shape[-1]),
        information=empty(members, 6, 6),
        cutoff=empty(members) + robust.EFFICIENT,
        iterations=torch.zeros_like(number),
    )


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
) -> TriedPoses:
    """The random search of initial values: C ignored first, then from anywhere."""
    everything = problem.with_every_pair()
    if restart == 0:
        starts = _hypotheses(everything, search, generator)
        _, tried = _attempt(everything, starts, search, nearest_candidate)
    else:
        starts = random_starts(problem.model, problem.measured, search.starts, generator=generator)
        cutoff = start_cutoff(everything, starts, nearest_candidate)
        fit = procedure_3_5(everything, starts, cutoff, detect=nearest_candidate, steps=COARSE)
        tried = _detected_again(everything, fit, search)
    return tried._replace(supported=_support(problem, tried))


def _attempt(
    problem: ElementProblem, starts: Hypotheses, search: ElementSearch, detect: Detect
) -> tuple[Hypotheses, TriedPoses]:
    """The best hypotheses, fitted to the candidates and then to all that is detected again.

    Returns:
        The poses that most candidates support; all poses after the detection.
    """
    starts = starts[_worth_fitting(problem, starts)]
    cutoff = torch.full_like(starts.T[:, 0, 0], GATE)
    fit = procedure_3_5(problem, starts, cutoff, detect=detect, steps=COARSE)
    near = _near(problem, fit.poses)
    supported = distinct(near & problem.candidates[starts.batch])
    members = len(problem.candidates)
    best = are_best(starts.batch, supported, members) & are_new(starts.batch, near)
    promising = are_best(starts.batch, distinct(near), members)
    return fit.poses[best], _detected_again(problem, fit.rows(promising), search)


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
    return explained(poses, problem.model, problem.measured, problem.deviation, gate=GATE)


def _support(problem: ElementProblem, tried: TriedPoses) -> Tensor:
    """How many of the pairs that each pose explains are candidates."""
    poses = Hypotheses(batch=tried.problem, T=tried.T)
    return distinct(_near(problem, poses) & problem.candidates[tried.problem])


def _detected_again(
    problem: ElementProblem, before: ElementFit, search: ElementSearch
) -> TriedPoses:
    """Correspondences detected anew among all pairs, C ignored, and the last fit (3.5 (1))."""
    everything = problem.with_every_pair()
    cutoff = torch.full_like(before.cutoff, GATE)
    fit = procedure_3_5(
        everything,
        before.poses,
        cutoff,
        detect=nearest_candidate,
        least=search.least_cutoff,
    )
    rests_on = correspondences(everything, fit, nearest_candidate)
    near = _near(problem, fit.poses)
    return TriedPoses(
        problem=fit.poses.batch,
        T=fit.poses.T,
        explained=distinct(near),
        supported=distinct(near & problem.candidates[fit.poses.batch]),
        cost=rests_on.cost,
        partner=rests_on.pairs.measured,
        weights=rests_on.weights,
        information=rests_on.information,
        cutoff=fit.cutoff,
        iterations=before.iterations + fit.iterations,
    )


def _check(model: Elements, measured: Elements, candidates: Tensor) -> None:
    found, expected = tuple(candidates.shape[-2:]), (model.count, measured.count)
    if found != expected:
        raise ValueError(
            f"candidates have the shape {found} (model, measured) for {expected[0]} elements of "
            f"the model and {expected[1]} measured ones"
        )
    if 0 in expected:
        raise ValueError(
            f"{expected[0]} elements of the model and {expected[1]} measured ones; "
            "there must be one of each at least"
        )
    if candidates.dtype != torch.bool:
        raise ValueError(f"candidates are {candidates.dtype}; the matrix C must be torch.bool")
    if model.point.dtype != measured.point.dtype:
        raise ValueError(
            f"the model's elements are {model.point.dtype}, the measured ones "
            f"{measured.point.dtype}; both must be the same"
        )
    if (measured.deviation().position == 0).any():
        raise ValueError(
            "measured elements without a covariance; give the covariance of their noise (m^2)"
        )
