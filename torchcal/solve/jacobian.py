"""The derivative A of the measurement model (eq. 13): its type, and the paper's way to it.

The package's own models have derivatives in closed form, which are checked against this one. It is
for residuals that nobody has differentiated.
"""

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor

Residual: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""Whitened residuals v (eq. 15) of some problems: of their states ``(active, ...)`` and indices."""
Linearise: TypeAlias = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""The same with the derivative A of the prediction on a last axis: v falls by A times the step."""
Retract: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""Moves states by steps ``(active, parameter)``."""


def numerical(
    residual: Residual, retract: Retract, parameters: int, *, step: float | None = None
) -> Linearise:
    """The derivative by central differences: the paper's numerical differentiation (3.3).

    Args:
        residual: Any function.
        retract: Moves states by steps.
        parameters: Length of a step.
        step: Half of the difference, in the parameters' units; by default the cube root of the
            precision, where rounding and curvature are alike.
    """

    def linearise(state: Tensor, problem: Tensor) -> tuple[Tensor, Tensor]:
        h = torch.finfo(state.dtype).eps ** (1 / 3) if step is None else step
        steps = h * torch.eye(parameters, dtype=state.dtype, device=state.device)
        columns = [
            residual(retract(state, -dx.expand(len(state), -1)), problem)
            - residual(retract(state, dx.expand(len(state), -1)), problem)
            for dx in steps
        ]
        return residual(state, problem), torch.stack(columns, -1) / (2.0 * h)

    return linearise
