"""Lengths and angles that no motion changes: which pairs may hold together (eq. 6)."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.match.elements import Elements, Kind

GAMMA = 5.0
"""The threshold of eq. 6 in standard deviations of the difference."""
PARALLEL = 0.1
"""Sine under which two lines count as parallel, and a line and a plane as well."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Invariants:
    """The characteristic values of every two elements of a set."""

    angle: Float[Tensor, "*batch element element"]
    """Between two directions, of lines the acute one; 0 where a point takes part (rad)."""
    angle_variance: Float[Tensor, "*batch element element"]
    distance: Float[Tensor, "*batch element element"]
    """Between points and lines, of a point above a plane, and 0 for every other two (m)."""
    distance_variance: Float[Tensor, "*batch element element"]

    @staticmethod
    def of(elements: Elements) -> "Invariants":
        """The angle and the distance of every two elements, with their standard deviations."""
        one, two = elements.kind[..., :, None], elements.kind[..., None, :]
        deviation = elements.deviation()
        offset = elements.point[..., None, :, :] - elements.point[..., :, None, :]
        distance = offset.norm(dim=-1)
        position_variance = _sum_of_squares(deviation.position)
        direction_variance = _sum_of_squares(deviation.direction)
        angle = torch.zeros_like(distance)
        if elements.directed:
            # A direction that is off by a little moves what is far from its point by much.
            lever = _levers(elements, one, two, distance)
            position_variance = position_variance + direction_variance * lever.square()
            angle = _angles(elements, one, two)
            distance = _distances(elements, one, two, offset, distance)
        return Invariants(
            angle=angle,
            angle_variance=direction_variance,
            distance=distance,
            distance_variance=position_variance,
        )

    def agree(
        self,
        other: "Invariants",
        batch: Int[Tensor, "*pair"],
        own: tuple[Int[Tensor, "*pair"], Int[Tensor, "*pair"]],
        others: tuple[Int[Tensor, "*pair"], Int[Tensor, "*pair"]],
    ) -> Bool[Tensor, "*pair"]:
        """Whether two of these elements may be the two others: |u_m - u_r| < gamma (eq. 6).

        Args:
            other: Characteristic values of the other set, with the same single batch axis.
            batch: The member of the batch.
            own: Two elements of this set.
            others: Two elements of the other set.
        """
        count, other_count = self.angle.shape[-1], other.angle.shape[-1]
        own_index = (batch * count + own[0]) * count + own[1]
        other_index = (batch * other_count + others[0]) * other_count + others[1]
        agrees = _within(
            _taken(self.distance, own_index) - _taken(other.distance, other_index),
            _taken(self.distance_variance, own_index),
            _taken(other.distance_variance, other_index),
        )
        if not (self.angle.any() or other.angle.any()):
            return agrees
        return agrees & _within(
            _taken(self.angle, own_index) - _taken(other.angle, other_index),
            _taken(self.angle_variance, own_index),
            _taken(other.angle_variance, other_index),
        )


def _taken(table: Tensor, index: Tensor) -> Tensor:
    """Entries of a batch of tables by their numbers: much faster than by three indices each."""
    return table.reshape(-1).index_select(0, index.reshape(-1)).view(index.shape)


def _within(difference: Tensor, variance: Tensor, other_variance: Tensor) -> Tensor:
    rounding = 1e3 * torch.finfo(difference.dtype).eps
    return difference.square() <= GAMMA**2 * (variance + other_variance) + rounding**2


def _sum_of_squares(sigma: Tensor) -> Tensor:
    return sigma[..., :, None].square() + sigma[..., None, :].square()


def _levers(elements: Elements, one: Tensor, two: Tensor, points: Tensor) -> Tensor:
    """How much a turn moves a distance: lines at a small angle meet far from their points."""
    a, b = elements.direction[..., :, None, :], elements.direction[..., None, :, :]
    sine = torch.linalg.cross(*torch.broadcast_tensors(a, b)).norm(dim=-1)
    lines = (one == Kind.LINE) & (two == Kind.LINE)
    return torch.where(lines, points / sine.clamp(min=PARALLEL), points)


def _angles(elements: Elements, one: Tensor, two: Tensor) -> Tensor:
    """Angles between directions; atan2 keeps small ones exact."""
    a, b = elements.direction[..., :, None, :], elements.direction[..., None, :, :]
    cosine = (a * b).sum(-1)
    sine = torch.linalg.cross(*torch.broadcast_tensors(a, b)).norm(dim=-1)
    undirected = (one == Kind.LINE) | (two == Kind.LINE)
    angle = torch.atan2(sine, torch.where(undirected, cosine.abs(), cosine))
    return torch.where((one == Kind.POINT) | (two == Kind.POINT), 0.0, angle)


def _distances(
    elements: Elements, one: Tensor, two: Tensor, offset: Tensor, points: Tensor
) -> Tensor:
    """Distances that only the kinds at hand have: two planes, or line and plane, have none."""
    a, b = elements.direction[..., :, None, :], elements.direction[..., None, :, :]
    along_a, along_b = (a * offset).sum(-1), (b * offset).sum(-1)
    normal = torch.linalg.cross(*torch.broadcast_tensors(a, b))
    sine = normal.norm(dim=-1)
    skew = (normal * offset).sum(-1).abs() / sine.clamp(min=PARALLEL)
    from_line = (points.square() - (along_a + along_b).square()).clamp(min=0.0).sqrt()
    parallel = (points.square() - along_a.square()).clamp(min=0.0).sqrt()

    def kinds(first: Kind, second: Kind) -> Tensor:
        return ((one == first) & (two == second)) | ((one == second) & (two == first))

    # A point's direction is 0, so the sum of both projections is the other element's.
    result = torch.where(kinds(Kind.POINT, Kind.POINT), points, torch.zeros_like(points))
    result = torch.where(kinds(Kind.POINT, Kind.LINE), from_line, result)
    above = torch.where(one == Kind.POINT, -along_b, along_a)
    result = torch.where(kinds(Kind.POINT, Kind.PLANE), above, result)
    lines = torch.where(sine > PARALLEL, skew, parallel)
    return torch.where(kinds(Kind.LINE, Kind.LINE), lines, result)
