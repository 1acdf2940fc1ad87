"""Where to start: hypotheses drawn from the prior, aligned with the nearest patches of the model.

Section 3.5 starts from the initial values and, where no good estimate follows, from random ones.
Here all starts run at once; those that end apart and explain the points best go on to the images.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.calibrate.nearest_fit import NearestFit
from torchcal.calibrate.observation import Observation
from torchcal.calibrate.parameters import Parameters
from torchcal.model.scene import Surface
from torchcal.solve.gauss_newton import GaussNewtonConfig, Solution, minimise, shared

STARTS = 32
"""The nominal state and draws from the prior."""
LOOKED_AT = 8
"""States that are aligned once more, with what of the model is seen from them."""
KEPT = 4
"""Of these, the states that go on to the images."""
POINTS = 2000
"""Measured points in all frames together."""
APART = 0.1
"""States that differ by less than this many prior sigmas in every parameter count as one."""
FAR = 0.05
"""m and rad: a difference that is never small, however wide the prior is."""


def candidate_states(
    observation: Observation,
    surface: Surface,
    parameters: Parameters,
    generator: torch.Generator,
) -> Float[Tensor, "candidate slot 4 4"]:
    """States that explain the measured points, the best first; the nominal one if none does."""
    count = max(50, POINTS // len(observation.range))

    def aligned(state: Tensor, starts: Tensor) -> Solution:
        fit = NearestFit.of(
            observation, surface, parameters, state, count=count, generator=generator
        )
        config = GaussNewtonConfig(iterations=15, ripple=0.01)
        return minimise(shared(fit.evaluate), parameters.retract, starts, config)

    first = aligned(parameters.nominal, _starts(parameters, generator))
    starts = best_apart(first.state, first.equations.cost, parameters, LOOKED_AT)
    again = [aligned(state, state[None]) for state in starts]
    states = torch.cat([solution.state for solution in again])
    costs = torch.cat([solution.equations.cost for solution in again])
    return torch.stack(best_apart(states, costs, parameters, KEPT))


def best_apart(
    states: Float[Tensor, "state slot 4 4"],
    costs: Float[Tensor, " state"],
    parameters: Parameters,
    count: int,
) -> list[Tensor]:
    """The best states that are apart from each other, the best first.

    Those that contradict the prior come last: they can be no answer, and would crowd out another
    that can.
    """
    order = costs.nan_to_num(torch.inf).argsort()
    contradicting = parameters.contradicts_prior(states[order])
    order = order[contradicting.int().argsort(stable=True)]
    kept: list[Tensor] = []
    for state in states[order]:
        if len(kept) < count and all(states_are_apart(state, other, parameters) for other in kept):
            kept.append(state)
    return kept


def states_are_apart(
    state: Float[Tensor, "slot 4 4"], other: Float[Tensor, "slot 4 4"], parameters: Parameters
) -> bool:
    """Whether states differ by more than ``APART`` prior sigmas or ``FAR`` in some parameter."""
    difference = parameters.difference(state, other) / parameters.prior_sigma
    far = (APART * parameters.prior_sigma).clamp(max=FAR) / parameters.prior_sigma
    return bool((difference.abs() > far).any())


def _starts(parameters: Parameters, generator: torch.Generator) -> Tensor:
    """The nominal state, and draws that fill the prior more evenly than independent ones."""
    count = len(parameters.names)
    seed = int(torch.randint(1 << 31, (), generator=generator))
    even = torch.quasirandom.SobolEngine(count, scramble=True, seed=seed).draw(STARTS)
    steps = torch.special.ndtri(even.double().clamp(1e-3, 1.0 - 1e-3))
    steps[0] = 0.0
    steps = steps.to(parameters.prior_sigma) * parameters.prior_sigma
    return parameters.retract(parameters.nominal.expand(STARTS, *parameters.nominal.shape), steps)
