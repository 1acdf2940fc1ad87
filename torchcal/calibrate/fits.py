"""Fits of a recording (section 3): the start that explains it best, then every pixel."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.calibrate.observation import (
    Observation,
    coarse_factor,
    coarse_images,
    cropped,
    observe,
)
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.refine import (
    Refined,
    coarse_fit,
    fine_factor,
    fine_fit,
    widely_fitted,
)
from torchcal.calibrate.rivals import Look, is_rival
from torchcal.calibrate.search import candidate_states, states_are_apart
from torchcal.calibrate.stages import Tick, quiet
from torchcal.model.job import Job
from torchcal.model.scene import Scene

EXPLAINED = 0.2
"""Share of the compared pixels that must agree before a pose counts as an explanation."""
EXPLAINED_ANYWHERE = 0.6
"""The same for a pose that no prior vouches for."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Choice:
    """The start that explains the coarse images best, and those that explain them as well."""

    state: Float[Tensor, "slot 4 4"]
    score: float
    """Robust cost per measured pixel of the coarse images."""
    rivals: tuple[tuple[Tensor, float], ...]
    """State and score."""
    least_agreement: float = EXPLAINED
    """Share of the compared pixels that must agree in the end."""


def choose_start(
    job: Job,
    scene: Scene,
    parameters: Parameters,
    generator: torch.Generator,
    tick: Tick = quiet,
) -> Choice:
    """Hypotheses from the prior, robust fits and a score that needs no truth (3.5)."""
    coarse = coarse_images(job)
    candidates = candidate_states(coarse, scene.surface, parameters, generator)
    return _best(coarse, scene, parameters, candidates, tick)


def choose_found(
    job: Job,
    scene: Scene,
    parameters: Parameters,
    states: Float[Tensor, "state slot 4 4"],
    tick: Tick = quiet,
) -> Choice:
    """The same among states that were found without a prior: more must agree with one."""
    choice = _best(coarse_images(job), scene, parameters, states, tick)
    return replace(choice, least_agreement=EXPLAINED_ANYWHERE)


def _best(
    coarse: Observation, scene: Scene, parameters: Parameters, candidates: Tensor, tick: Tick
) -> Choice:
    fit, solution = coarse_fit(coarse, scene.surface, parameters, candidates, tick)
    costs = solution.equations.cost.nan_to_num(torch.inf)
    states, costs = _apart_from_first(solution.state, costs, parameters)
    states, costs = _apart_from_first(*widely_fitted(fit, states, costs), parameters)
    scores = (costs / coarse.measured.sum().clamp(min=1)).tolist()
    # Most often there is nothing else to look at.
    look = Look.of(fit, states[0]) if len(states) > 1 else None
    rivals = tuple(
        (state, score)
        for state, score in zip(states[1:], scores[1:], strict=True)
        if look is not None and is_rival(fit, state, look)
    )
    return Choice(state=states[0], score=scores[0], rivals=rivals)


def _apart_from_first(
    states: Float[Tensor, "state slot 4 4"], costs: Float[Tensor, " state"], parameters: Parameters
) -> tuple[Float[Tensor, "kept slot 4 4"], Float[Tensor, " kept"]]:
    """The state of least cost and those that are apart from it, in the order of their costs."""
    order = costs.argsort()
    states, costs = states[order], costs[order]
    apart = [states_are_apart(state, states[0], parameters) for state in states[1:]]
    kept = torch.tensor([True, *apart], device=costs.device)
    return states[kept], costs[kept]


def fit_pixels(
    job: Job,
    scene: Scene,
    parameters: Parameters,
    state: Float[Tensor, "slot 4 4"],
    tick: Tick = quiet,
) -> Refined:
    """The fit that shows which pixels differ: at half of the final resolution."""
    observation = cropped(observe(job))
    factor = min(2 * fine_factor(observation), coarse_factor(observation.sensor))
    return fine_fit(observation, scene.surface, parameters, state, factor=factor, tick=tick)


def fit_rest(
    job: Job,
    scene: Scene,
    parameters: Parameters,
    before: Refined,
    excluded: Bool[Tensor, "frame h w"],
    tick: Tick = quiet,
) -> Refined:
    """The final fit, without the pixels that turned out to show something else."""
    observation = cropped(observe(job).without(excluded))
    if not observation.measured.any():
        return before
    factor = fine_factor(observation)
    return fine_fit(observation, scene.surface, parameters, before.state, factor=factor, tick=tick)
