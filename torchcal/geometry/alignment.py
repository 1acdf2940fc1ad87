"""Closed forms for the pose that carries one set of geometry onto another (3.2)."""

import torch
from jaxtyping import Float
from torch import Tensor


def rotation_from_directions(
    a: Float[Tensor, "*batch 2 3"], b: Float[Tensor, "*batch 2 3"]
) -> Float[Tensor, "*batch 3 3"]:
    """The rotation R with ``b = R a`` for two directions; their errors are shared equally.

    Args:
        a: Two directions of any length; not finite where they are parallel or zero.
        b: The same two directions in the other frame; where the angles differ, the bisectors agree.
    """
    return _frame_of_directions(b) @ _frame_of_directions(a).mT


def _frame_of_directions(pair: Tensor) -> Tensor:
    """A right-handed frame of the two bisectors and the normal, as columns."""
    first, second = (pair / pair.norm(dim=-1, keepdim=True)).unbind(-2)
    bisectors = torch.stack([first + second, first - second], -2)
    along, across = (bisectors / bisectors.norm(dim=-1, keepdim=True)).unbind(-2)
    return torch.stack([along, across, torch.linalg.cross(along, across)], -1)


def solve_3x3(
    matrix: Float[Tensor, "*batch 3 3"], right: Float[Tensor, "*batch 3"], *, least: float
) -> Float[Tensor, "*batch 3"]:
    """Cramer's rule for many small systems; NaN where the determinant is below ``least``."""
    one, two, three = matrix.unbind(-1)
    crosses = torch.stack(
        [
            torch.linalg.cross(two, three),
            torch.linalg.cross(three, one),
            torch.linalg.cross(one, two),
        ],
        -2,
    )
    determinant = (one * crosses[..., 0, :]).sum(-1, keepdim=True)
    solved = (crosses * right[..., None, :]).sum(-1) / determinant
    return torch.where(determinant.abs() < least, torch.nan, solved)


def orthonormal_axes(direction: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Rows of a right-handed frame whose last row is the direction (unit length)."""
    smallest = direction.abs().argmin(-1, keepdim=True)
    helper = torch.zeros_like(direction).scatter(-1, smallest, 1.0)
    first = torch.nn.functional.normalize(torch.linalg.cross(helper, direction), dim=-1)
    return torch.stack([first, torch.linalg.cross(direction, first), direction], -2)
