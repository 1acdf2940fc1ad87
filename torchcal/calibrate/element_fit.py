"""Procedure 3.5, steps (1) to (5): the robust fit of elements from given starting values."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry import robust, se3
from torchcal.match.detection import Detect
from torchcal.match.elements import Deviation, Elements
from torchcal.match.minimal_sets import Hypotheses
from torchcal.match.pairs import Pairs
from torchcal.match.residuals import PairResiduals, Whitening
from torchcal.match.support import standard_errors
from torchcal.solve.correspondences import RobustCorrespondences
from torchcal.solve.gauss_newton import GaussNewtonConfig, Solution, minimise

COARSE = GaussNewtonConfig(iterations=5, damping=1e-6, tolerance=0.1)
"""Steps that are followed by a better detection."""
FINE = GaussNewtonConfig(iterations=10, damping=1e-6)
"""Steps of the last fit."""


@dataclass(frozen=True, kw_only=True, slots=True)
class ElementProblem:
    """What is to be matched: model and measured elements of every member of a batch."""

    model: Elements
    measured: Elements
    deviation: Deviation
    """Of ``measured``."""
    whitening: Whitening
    candidates: Bool[Tensor, "batch model measured"]
    """The matrix C of eq. 6."""

    @staticmethod
    def of(
        model: Elements, measured: Elements, candidates: Bool[Tensor, "batch model measured"]
    ) -> "ElementProblem":
        """With the noise's axes and roots worked out.

        Measured elements whose covariance is not definite count as not measured.
        """
        whitening, deviation = Whitening.of(measured), measured.deviation()
        definite = whitening.root.isfinite().all(-1).all(-1)
        return ElementProblem(
            model=model,
            measured=measured,
            deviation=Deviation(
                position=torch.where(definite, deviation.position, torch.nan),
                direction=torch.where(definite, deviation.direction, torch.nan),
            ),
            whitening=whitening,
            candidates=candidates & definite[:, None],
        )

    def rows(self, chosen: Int[Tensor, " member"]) -> "ElementProblem":
        """Some members of the batch."""
        return ElementProblem.of(self.model[chosen], self.measured[chosen], self.candidates[chosen])

    def with_every_pair(self) -> "ElementProblem":
        """The same with C ignored."""
        return ElementProblem(
            model=self.model,
            measured=self.measured,
            deviation=self.deviation,
            whitening=self.whitening,
            candidates=torch.ones_like(self.candidates),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class ElementFit:
    """Where procedure 3.5 ended from every start."""

    poses: Hypotheses
    cutoff: Float[Tensor, " hypothesis"]
    """c of eq. 16 at the end."""
    iterations: Int[Tensor, " hypothesis"]
    """Steps of nonlinear least squares in all rounds."""

    def rows(self, chosen: Tensor) -> "ElementFit":
        """Some of the fits."""
        return ElementFit(
            poses=self.poses[chosen],
            cutoff=self.cutoff[chosen],
            iterations=self.iterations[chosen],
        )


def procedure_3_5(
    problem: ElementProblem,
    starts: Hypotheses,
    cutoff: Float[Tensor, " hypothesis"],
    *,
    detect: Detect,
    steps: GaussNewtonConfig = FINE,
    least: float = robust.EFFICIENT,
    rounds: int = 6,
) -> ElementFit:
    """Steps (1) to (5) of 3.5 from every start.

    Args:
        problem: Elements and candidates.
        starts: Initial values of the poses.
        cutoff: First c of eq. 16 in standard deviations; it only shrinks.
        detect: Step (1).
        steps: Settings of (2) after the first round, which only finds what is wrong.
        least: Where c stops shrinking; 0 for the literal eq. 16.
        rounds: Most repetitions of (1) to (4).
    """
    T, c = starts.T.clone(), cutoff.clone()
    iterations = torch.zeros_like(starts.batch)
    lowest = torch.full_like(c, torch.inf)
    active = torch.arange(len(c), device=c.device)
    for config in [COARSE, *[steps] * (rounds - 1)]:
        now = Hypotheses(batch=starts.batch[active], T=T[active])
        _, equations = _detected(problem, now, c[active], detect)  # (1) and (4)
        solution = minimise(equations.evaluate, _retract, now.T, config)  # (2) and (3)
        smaller = _smaller_cutoff(equations, solution, least)
        T[active] = solution.state
        iterations[active] += solution.iterations
        still = (solution.iterations <= 1) | ~_is_lower(solution, lowest[active])
        settled = still & (smaller >= c[active])  # (5)
        lowest[active] = torch.where(smaller < c[active], torch.inf, solution.equations.cost)
        c[active] = smaller
        active = active[~settled]
        if len(active) == 0:
            break
    poses = Hypotheses(batch=starts.batch, T=T)
    return ElementFit(poses=poses, cutoff=c, iterations=iterations)


@dataclass(frozen=True, kw_only=True, slots=True)
class Correspondences:
    """What a fit rests on."""

    pairs: Pairs
    weights: Float[Tensor, "hypothesis pair component"]
    """Biweights after eq. 15; 0 for correspondences that were found wrong, and for padding."""
    explained: Bool[Tensor, "hypothesis pair"]
    """Pairs of which no component is beyond c, or beyond 4.685 where c is less."""
    cost: Float[Tensor, " hypothesis"]
    """The sum of rho."""
    misfit: Float[Tensor, " hypothesis"]
    """By how many standard deviations the squared residuals of the explained pairs are larger
    than those of noise alone."""
    information: Float[Tensor, "hypothesis 6 6"]
    """A^T W A of the correspondences that kept their weight, without biweights."""


def correspondences(problem: ElementProblem, fit: ElementFit, detect: Detect) -> Correspondences:
    """The correspondences at the end of a fit, with their weights.

    Args:
        problem: Elements and candidates.
        fit: Poses and cut-offs.
        detect: Step (1).
    """
    pairs, equations = _detected(problem, fit.poses, fit.cutoff, detect)
    everyone = torch.arange(len(fit.cutoff), device=fit.cutoff.device)
    v, A = equations.linearise(fit.poses.T, everyone)
    weights = equations.weights(v)
    reach = fit.cutoff.clamp(min=robust.EFFICIENT)[:, None, None]
    within = ((v.abs() < reach) | ~equations.present).all(-1) & equations.present.any(-1)
    used = equations.present & within[..., None]
    A = torch.where((weights > 0)[..., None], A, 0.0).flatten(1, 2)
    return Correspondences(
        pairs=pairs,
        weights=weights,
        explained=within,
        cost=equations.costs(v),
        misfit=_misfit(torch.where(used, v, 0.0), used),
        information=A.mT @ A,
    )


def _misfit(v: Tensor, used: Tensor) -> Tensor:
    """Chi-square of the residuals as a normal deviate: its cube root is nearly Gaussian."""
    freedom = (used.flatten(1).sum(1) - 6).clamp(min=1)
    variance = 2.0 / (9.0 * freedom)
    root = (v.square().flatten(1).sum(1) / freedom) ** (1 / 3)
    return (root - (1.0 - variance)) / variance.sqrt()


def start_cutoff(
    problem: ElementProblem, starts: Hypotheses, detect: Detect
) -> Float[Tensor, " hypothesis"]:
    """Eq. 16 for starts of which nothing is known: zeta times the median of what is nearest."""
    everything = torch.full_like(starts.T[:, 0, 0], torch.inf)
    _, equations = _detected(problem, starts, everything, detect)
    v, _ = equations.linearise(starts.T, torch.arange(len(starts.T), device=starts.T.device))
    return robust.cutoff(_all_residuals(v, equations.present))


def _detected(
    problem: ElementProblem, poses: Hypotheses, cutoff: Tensor, detect: Detect
) -> tuple[Pairs, RobustCorrespondences]:
    """The correspondences at some poses and their measurement equations."""
    error = standard_errors(poses, problem.model, problem.measured, problem.deviation)
    # A median far below would drop right pairs for good, and then be that of fewer and fewer.
    reach = cutoff.clamp(min=robust.EFFICIENT)
    pairs = detect(error, problem.candidates[poses.batch], reach)
    residuals = PairResiduals.of(
        problem.model, problem.measured, problem.whitening, poses.batch, pairs
    )
    equations = RobustCorrespondences(
        linearise=residuals.linearise, present=residuals.present, cutoff=cutoff
    )
    return pairs, equations


def _retract(T: Tensor, step: Tensor) -> Tensor:
    return T @ se3.exp(step)


def _is_lower(solution: Solution, lowest: Tensor) -> Tensor:
    """Whether the cost fell by more than half the square of a short step."""
    return solution.equations.cost < lowest - 0.5 * COARSE.tolerance**2


def _smaller_cutoff(equations: RobustCorrespondences, solution: Solution, least: float) -> Tensor:
    """Eq. 16 at the solution: not above the last c, so that it shrinks with the fit."""
    everyone = torch.arange(len(solution.state), device=solution.state.device)
    v, _ = equations.linearise(solution.state, everyone)
    c = robust.cutoff(_all_residuals(v, equations.present), least=least)
    return torch.minimum(c, equations.cutoff)


def _all_residuals(v: Tensor, present: Tensor) -> Float[Tensor, "hypothesis residual"]:
    """Of every hypothesis; NaN where there is no correspondence."""
    return torch.where(present, v, torch.nan).flatten(1)
