"""Batched damped Gauss-Newton on manifolds (eq. 9 to 13).

Each element of the batch is a problem of its own, with its own damping, acceptance and stop. A step
is accepted on the robust cost, the sum of rho, never on the weighted squares.
"""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

LEAST_DAMPING, MOST_DAMPING = 1e-9, 1e6
"""Bounds of lambda of eq. 12; an element that would need more is stuck."""


class StopReason(IntEnum):
    """Why an element of the batch stopped."""

    CONVERGED = 0
    ITERATIONS = 1
    """The iterations were used up."""
    STUCK = 2
    """No damping gave a step that was accepted."""
    INVALID = 3
    """The cost or its derivatives were not finite at the start."""


@dataclass(frozen=True, kw_only=True, slots=True)
class NormalEquations:
    """A batch of linearised problems: cost and its quadratic model in the step."""

    cost: Float[Tensor, "*batch"]
    """The sum of rho; infinite where the state is impossible."""
    information: Float[Tensor, "*batch parameter parameter"]
    """A^T W A of eq. 12."""
    gradient: Float[Tensor, "*batch parameter"]
    """A^T W (y - f): the direction in which the cost falls."""

    def where(self, accept: Tensor, other: "NormalEquations") -> "NormalEquations":
        """These elements where ``accept`` holds, the others elsewhere."""
        return NormalEquations(
            cost=torch.where(accept, self.cost, other.cost),
            information=torch.where(accept[:, None, None], self.information, other.information),
            gradient=torch.where(accept[:, None], self.gradient, other.gradient),
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class GaussNewtonConfig:
    """Settings of the damped Gauss-Newton iteration."""

    iterations: int = 20
    """Most steps that are tried."""
    damping: float = 1e-4
    """First lambda of eq. 12, relative to the diagonal of the information."""
    tolerance: float = 1e-2
    """Stop when the step is shorter than this many of its own standard deviations."""
    ripple: float = 0.0
    """Share of the cost by which an accepted step may raise it: pixels and small faces put ripples
    on the cost of an image that say nothing about where its minimum is."""
    longest: float = 1.0
    """Most that a step is lengthened where the gradient falls more slowly than the information
    says, as it does where the derivatives are themselves noisy."""
    curvature: float = 1.0
    """How fast the gradient falls, over what the information says; with robust weights near a
    minimum, ``robust.relative_curvature``: steps then converge quadratically."""
    trusted: float = 0.0
    """A step shorter than this many of its standard deviations is the last and not evaluated."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Solution:
    """The end state of every element."""

    state: Tensor
    equations: NormalEquations
    """At ``state``, or where it was before a last step that was trusted."""
    stop: Int[Tensor, " batch"]
    """One ``StopReason`` each."""
    iterations: Int[Tensor, " batch"]


def minimise(
    evaluate: Callable[[Tensor, Tensor], NormalEquations],
    retract: Callable[[Tensor, Tensor], Tensor],
    state: Tensor,
    config: GaussNewtonConfig,
) -> Solution:
    """Minimises a batch of robust nonlinear least-squares problems (eq. 9 to 13).

    Elements that have stopped are not evaluated any more.

    Args:
        evaluate: Normal equations of some elements at the given states; the second argument says
            which elements they are, so that each may have data of its own.
        retract: Moves a batch of states by steps ``(batch, parameter)``.
        state: Where to start, ``(batch, ...)``.
        config: Iterations, damping and stop.
    """
    whole = _started(state, evaluate, config)
    element = torch.arange(len(state), device=state.device)
    running = whole
    for _ in range(config.iterations):
        if config.trusted > 0.0:
            running = _trusting(running, retract, config)
        keep = running.stop == StopReason.ITERATIONS
        if not keep.all():
            whole = whole.put(element, running)
            element, running = element[keep], running.rows(keep)
        if len(element) == 0:
            break
        running = _iterate(running, element, evaluate, retract, config)
    whole = whole.put(element, running)
    return Solution(
        state=whole.state,
        equations=whole.equations(),
        stop=whole.stop,
        iterations=whole.iterations,
    )


def shared(
    evaluate: Callable[[Tensor], NormalEquations],
) -> Callable[[Tensor, Tensor], NormalEquations]:
    """What ``minimise`` evaluates where all elements have the same data."""
    return lambda state, _element: evaluate(state)


class _Progress(NamedTuple):
    """Where some elements are; every tensor has a row for each of them."""

    state: Tensor
    cost: Tensor
    information: Tensor
    gradient: Tensor
    damping: Tensor
    slopes: Tensor
    """How much the gradient fell in all steps, and how much the information said it would."""
    stop: Tensor
    iterations: Tensor

    def rows(self, chosen: Tensor) -> "_Progress":
        """Some of the elements."""
        return _Progress(*(values[chosen] for values in self))

    def put(self, index: Tensor, part: "_Progress") -> "_Progress":
        """With the rows of some elements replaced."""
        return _Progress(
            *(all_.index_copy(0, index, some) for all_, some in zip(self, part, strict=True))
        )

    def equations(self) -> NormalEquations:
        """At the state."""
        return NormalEquations(cost=self.cost, information=self.information, gradient=self.gradient)


def _started(
    state: Tensor,
    evaluate: Callable[[Tensor, Tensor], NormalEquations],
    config: GaussNewtonConfig,
) -> _Progress:
    first = evaluate(state, torch.arange(len(state), device=state.device))
    running, invalid = StopReason.ITERATIONS.value, StopReason.INVALID.value
    stop = torch.where(_is_finite(first), running, invalid)
    return _Progress(
        state=state,
        cost=first.cost,
        information=first.information,
        gradient=first.gradient,
        damping=torch.full_like(first.cost, config.damping),
        slopes=first.cost.new_zeros(len(state), 2),
        stop=stop,
        iterations=torch.zeros_like(stop),
    )


def _iterate(
    now: _Progress,
    element: Tensor,
    evaluate: Callable[[Tensor, Tensor], NormalEquations],
    retract: Callable[[Tensor, Tensor], Tensor],
    config: GaussNewtonConfig,
) -> _Progress:
    """One step of every element, accepted on the sum of rho, and what it says about stopping."""
    equations = now.equations()
    step, length = _next_step(now, config)
    state = retract(now.state, step)
    trial = evaluate(state, element)
    allowed = (1.0 + config.ripple) * now.cost
    accept = length.isfinite() & _is_finite(trial) & (trial.cost <= allowed)
    seen = accept & (length > 1.0)  # shorter steps see the ripple and not the curvature
    slopes = now.slopes + torch.where(seen[:, None], _slopes(equations, trial, step), 0.0)
    kept = trial.where(accept, equations)
    damping = torch.where(accept, 0.1 * now.damping, 10.0 * now.damping).clamp(min=LEAST_DAMPING)
    stop = torch.where(damping > MOST_DAMPING, StopReason.STUCK.value, now.stop)
    return _Progress(
        state=torch.where(_broadcast(accept, state), state, now.state),
        cost=kept.cost,
        information=kept.information,
        gradient=kept.gradient,
        damping=damping,
        slopes=torch.where(accept[:, None], slopes, 0.0),  # a rejected step is not lengthened
        stop=torch.where(length < config.tolerance, StopReason.CONVERGED.value, stop),
        iterations=now.iterations + 1,
    )


def _trusting(
    now: _Progress, retract: Callable[[Tensor, Tensor], Tensor], config: GaussNewtonConfig
) -> _Progress:
    """Takes the last step of every element that is so near that it need not be evaluated."""
    step, length = _next_step(now, config)
    last = (now.stop == StopReason.ITERATIONS) & (length < config.trusted)
    return now._replace(
        state=torch.where(_broadcast(last, now.state), retract(now.state, step), now.state),
        stop=torch.where(last, StopReason.CONVERGED.value, now.stop),
        iterations=now.iterations + last,
    )


def _next_step(now: _Progress, config: GaussNewtonConfig) -> tuple[Tensor, Tensor]:
    """The damped step with its lengthening; its length is that without either."""
    step, length = _damped_step(now.equations(), now.damping)
    seen = _curvature(now.slopes).clamp(min=1.0 / config.longest)
    return step / seen.clamp(max=config.curvature)[:, None], length


def _slopes(before: NormalEquations, after: NormalEquations, step: Tensor) -> Tensor:
    """How much the gradient fell along each step, and how much the information says it should."""
    fell = ((before.gradient - after.gradient) * step).sum(-1)
    expected = ((before.information @ step[..., None])[..., 0] * step).sum(-1)
    return torch.stack([fell, expected], -1)


def _curvature(slopes: Tensor) -> Tensor:
    """The share of the expected fall that was seen; 1 before anything was seen."""
    fell, expected = slopes.unbind(-1)
    seen = expected > 0
    return torch.where(seen, fell / torch.where(seen, expected, 1.0), 1.0).clamp(0.02, 1.0)


def covariance(
    information: Float[Tensor, "*batch parameter parameter"],
) -> Float[Tensor, "*batch parameter parameter"]:
    """Inverse of the information; NaN for elements where it is singular or not finite."""
    scale = information.diagonal(dim1=-2, dim2=-1).clamp(min=1e-300).rsqrt()
    scaled = information * scale[..., :, None] * scale[..., None, :]
    factor, good = _factorised(scaled)
    inverse = torch.where(good[..., None, None], torch.cholesky_inverse(factor), torch.nan)
    return inverse * scale[..., :, None] * scale[..., None, :]


def _factorised(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Cholesky factors, and where there is one; the identity for the other elements.

    The diagonal of the matrices is about 1. A squared pivot is then the share of a parameter's
    information that the others do not take; one of the size of rounding errors is none.
    """
    size = matrix.shape[-1]
    factor, failed = torch.linalg.cholesky_ex(matrix)
    pivot = factor.diagonal(dim1=-2, dim2=-1).square().amin(-1)
    good = (failed == 0) & (pivot > 10 * size * torch.finfo(matrix.dtype).eps)
    eye = torch.eye(size, dtype=matrix.dtype, device=matrix.device)
    return torch.where(good[..., None, None], factor, eye), good


def _damped_step(equations: NormalEquations, damping: Tensor) -> tuple[Tensor, Tensor]:
    """Solves (A^T W A + lambda diag) dx = gradient; 0 where that is not possible.

    Returns:
        The steps; what their lengths would be without damping, in standard deviations, infinite
        where there is no step. (Damping makes any step short; that is not convergence.)
    """
    information = equations.information
    scale = information.diagonal(dim1=-2, dim2=-1).clamp(min=1e-12).rsqrt()
    matrix = information * scale[:, :, None] * scale[:, None, :]
    matrix = matrix + torch.diag_embed(damping[:, None].expand_as(scale))
    right = equations.gradient * scale
    factor, good = _factorised(matrix)
    good = good & right.isfinite().all(1)
    right = torch.where(good[:, None], right, 0.0)
    solved = torch.cholesky_solve(right[..., None], factor)[..., 0]
    length = ((1.0 + damping) * (right * solved).sum(1).clamp(min=0.0)).sqrt()
    return solved * scale, torch.where(good, length, torch.inf)


def _is_finite(equations: NormalEquations) -> Tensor:
    """Which elements have a cost and derivatives."""
    parts = (equations.cost[:, None], equations.information, equations.gradient)
    return torch.stack([part.isfinite().flatten(1).all(1) for part in parts]).all(0)


def _broadcast(mask: Tensor, like: Tensor) -> Tensor:
    """A mask of elements with axes of length 1 for the axes of a state."""
    return mask.view(-1, *[1] * (like.ndim - 1))
