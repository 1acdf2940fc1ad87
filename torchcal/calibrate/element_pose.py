"""The pose of measured elements without a starting value: hypotheses, procedure 3.5, restarts."""

import math
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
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
from torchcal.calibrate.element_search import ElementSearch, check_elements
from torchcal.geometry import robust
from torchcal.match.detection import Detect, every_candidate, nearest_candidate
from torchcal.match.elements import Elements
from torchcal.match.minimal_sets import Hypotheses, minimal_hypotheses
from torchcal.match.random_starts import random_starts
from torchcal.match.support import are_best, are_new, count_distinct, explained, fingerprints

GATE = robust.ZETA * robust.EFFICIENT
"""Standard deviations within which a hypothesis explains an element: zeta steers the search, since
a pose from a minimal set carries the noise of its few elements."""


PAIRS_OF_CANDIDATES = 16_000_000
"""Most pairs of candidates, of all problems together, that are compared at a time."""


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
    check_elements(model, measured, candidates)
    batch = candidates.shape[:-2]
    model, measured = model.expand(*batch).flattened(), measured.expand(*batch).flattened()
    flat = candidates.reshape(batch.numel(), *candidates.shape[-2:])
    chunk = _chunk(flat, search)
    parts = []
    for first in range(0, max(len(flat), 1), chunk):
        rows = slice(first, first + chunk)
        own, own_centre = _centred(model[rows])
        others, centre = _centred(measured[rows])
        problem = ElementProblem.of(own, others, flat[rows])
        parts.append(_find(problem, search, detect, generator).moved_back(own_centre, centre))
    return joined(parts, batch)


def _chunk(candidates: Bool[Tensor, "problem model measured"], search: ElementSearch) -> int:
    """Problems at a time: fewer where every two of many candidates are compared."""
    pairs = int(candidates.flatten(1).sum(1).amax()) if len(candidates) else 0
    if pairs**2 > PAIRS_OF_CANDIDATES:
        raise ValueError(
            f"a problem has {pairs} candidates; at most {math.isqrt(PAIRS_OF_CANDIDATES)} can be "
            "compared with one another: narrow the matrix C"
        )
    return min(search.chunk, max(1, PAIRS_OF_CANDIDATES // max(pairs, 1) ** 2))


def _centred(elements: Elements) -> tuple[Elements, Float[Tensor, "problem 3"]]:
    """Elements about the mean of their points, so that no digits are lost far from the origin."""
    point = elements.point
    safe = torch.where(point.isfinite(), point, torch.nan)
    centre = safe.nanmean(-2).nan_to_num(0.0)
    return replace(elements, point=point - centre[:, None]), centre


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
        weak = (~best.is_good(enough)).nonzero()[:, 0]
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
        misfit=empty(members) + torch.inf,
        fingerprint=torch.zeros_like(number),
        partner=number.new_zeros(members, count),
        kept=torch.zeros(members, count, dtype=torch.bool, device=number.device),
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
    supported = _supported(problem, tried.problem, tried.partner, tried.kept)
    return tried._replace(supported=supported)


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
    supported = count_distinct(near & problem.candidates[starts.batch])
    members = len(problem.candidates)
    best = are_best(starts.batch, supported, members)
    best = best & are_new(starts.batch, _fingerprints(problem, fit.poses, near))
    promising = are_best(starts.batch, count_distinct(near), members)
    return fit.poses[best], _detected_again(problem, fit.rows(promising), search)


def _worth_fitting(problem: ElementProblem, starts: Hypotheses) -> Tensor:
    """One hypothesis for each pose that explains the most, with the candidates or with all."""
    near = _near(problem, starts)
    members = len(problem.candidates)
    supported = count_distinct(near & problem.candidates[starts.batch])
    score = count_distinct(near) * (problem.model.count + 1) + supported
    best = are_best(starts.batch, supported, members) | are_best(starts.batch, score, members)
    rows = best.nonzero()[:, 0]
    return rows[are_new(starts.batch[rows], _fingerprints(problem, starts[rows], near[rows]))]


def _near(problem: ElementProblem, poses: Hypotheses) -> Tensor:
    """The pairs that a pose explains, candidates or not."""
    return explained(poses, problem.model, problem.measured, problem.deviation, gate=GATE)


def _fingerprints(problem: ElementProblem, poses: Hypotheses, near: Tensor) -> Tensor:
    return fingerprints(poses, problem.model, problem.measured, near)


def _supported(problem: ElementProblem, batch: Tensor, partner: Tensor, kept: Tensor) -> Tensor:
    """How many elements are explained by candidates."""
    pairs = torch.zeros_like(problem.candidates[batch]).scatter(
        2, partner[..., None], kept[..., None]
    )
    return count_distinct(pairs & problem.candidates[batch])


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
    batch, partner = fit.poses.batch, rests_on.pairs.measured
    return TriedPoses(
        problem=batch,
        T=fit.poses.T,
        explained=_supported(everything, batch, partner, rests_on.explained),
        supported=_supported(problem, batch, partner, rests_on.explained),
        cost=rests_on.cost,
        misfit=rests_on.misfit,
        fingerprint=_fingerprints(problem, fit.poses, _near(problem, fit.poses)),
        partner=partner,
        kept=rests_on.explained,
        weights=rests_on.weights,
        information=rests_on.information,
        cutoff=fit.cutoff,
        iterations=before.iterations + fit.iterations,
    )
