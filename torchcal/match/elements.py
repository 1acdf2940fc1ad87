"""Elements of a range image or of a model: vertexes, straight lines and planes (3.1 (2))."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import torch
from jaxtyping import Float, Int
from torch import Tensor


class Kind(IntEnum):
    """What an element is."""

    POINT = 0
    LINE = 1
    """A straight line without a sense of direction."""
    PLANE = 2
    """With a normal that points to the side it is seen from."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Deviation:
    """The largest standard deviations of elements, of lines and planes across them."""

    position: Float[Tensor, "*batch element"]
    """m"""
    direction: Float[Tensor, "*batch element"]
    """rad"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Elements:
    """Points, lines and planes in one frame, each with the covariance of its noise (eq. 8)."""

    kind: Int[Tensor, "*batch element"]
    """One ``Kind`` each."""
    point: Float[Tensor, "*batch element 3"]
    """The point, or where on the line or plane its covariance holds (m)."""
    direction: Float[Tensor, "*batch element 3"]
    """Unit length: along the line, or the plane's normal; 0 for a point."""
    covariance: Float[Tensor, "*batch element 6 6"]
    """Of (point, direction), in m and rad: 0 for the elements of a model. Only its parts across a
    line, and along the normal of a plane, count; those must be definite for measured elements."""

    @staticmethod
    def points(
        point: Float[Tensor, "*batch element 3"],
        covariance: Float[Tensor, "*batch element 3 3"] | None = None,
    ) -> "Elements":
        """Vertexes (m) with their covariance; without one they are exact."""
        full = _exact(point)
        if covariance is not None:
            full[..., :3, :3] = covariance
        kind = torch.full(point.shape[:-1], Kind.POINT.value, device=point.device)
        return Elements(kind=kind, point=point, direction=torch.zeros_like(point), covariance=full)

    @staticmethod
    def lines(
        point: Float[Tensor, "*batch element 3"],
        direction: Float[Tensor, "*batch element 3"],
        covariance: Float[Tensor, "*batch element 6 6"] | None = None,
    ) -> "Elements":
        """Straight lines through points (m) along directions of any length but 0."""
        return _directed(Kind.LINE, point, direction, covariance)

    @staticmethod
    def planes(
        point: Float[Tensor, "*batch element 3"],
        normal: Float[Tensor, "*batch element 3"],
        covariance: Float[Tensor, "*batch element 6 6"] | None = None,
    ) -> "Elements":
        """Planes through points (m) with normals of any length but 0."""
        return _directed(Kind.PLANE, point, normal, covariance)

    @staticmethod
    def join(*parts: "Elements") -> "Elements":
        """All elements of several sets with the same batch."""
        return Elements(
            kind=torch.cat([part.kind for part in parts], -1),
            point=torch.cat([part.point for part in parts], -2),
            direction=torch.cat([part.direction for part in parts], -2),
            covariance=torch.cat([part.covariance for part in parts], -3),
        )

    def expand(self, *batch: int) -> "Elements":
        """The same elements for every member of a batch, without copies."""
        own = self.kind.ndim - 1
        return self._map(lambda values: values.expand(*batch, *values.shape[own:]))

    def flattened(self) -> "Elements":
        """With one batch axis."""
        own = self.kind.ndim - 1
        members = self.kind.shape[:own].numel()
        return self._map(lambda values: values.reshape(members, *values.shape[own:]))

    def to(self, device: str | torch.device) -> "Elements":
        """On another device."""
        return self._map(lambda values: values.to(device))

    def __getitem__(self, members: Tensor | slice) -> "Elements":
        """The elements of some members of the first batch axis."""
        return self._map(lambda values: values[members])

    def _map(self, change: Callable[[Tensor], Tensor]) -> "Elements":
        return Elements(
            kind=change(self.kind),
            point=change(self.point),
            direction=change(self.direction),
            covariance=change(self.covariance),
        )

    @property
    def count(self) -> int:
        """Elements of each member of the batch."""
        return self.kind.shape[-1]

    @property
    def directed(self) -> bool:
        """Whether there are lines or planes."""
        return bool((self.kind != Kind.POINT).any())

    def deviation(self) -> Deviation:
        """The largest standard deviations along the axes that count for the kind."""
        position, direction = self.covariance[..., :3, :3], self.covariance[..., 3:, 3:]
        if self.directed:
            along = self.direction[..., :, None] * self.direction[..., None, :]
            eye = torch.eye(3, dtype=along.dtype, device=along.device)
            is_plane = (self.kind == Kind.PLANE)[..., None, None]
            counted = torch.where(is_plane, along, eye - along)
            position, direction = (
                counted @ position @ counted,
                (eye - along) @ direction @ (eye - along),
            )
        return Deviation(position=_largest(position), direction=_largest(direction))


def _directed(kind: Kind, point: Tensor, direction: Tensor, covariance: Tensor | None) -> Elements:
    if (direction == 0).all(-1).any():
        raise ValueError(f"a direction of a {kind.name.lower()} has the length 0")
    return Elements(
        kind=torch.full(point.shape[:-1], kind.value, device=point.device),
        point=point,
        direction=torch.nn.functional.normalize(direction, dim=-1),
        covariance=_exact(point)
        if covariance is None
        else covariance.expand(*point.shape[:-1], 6, 6),
    )


def _exact(point: Tensor) -> Tensor:
    return torch.zeros(*point.shape[:-1], 6, 6, dtype=point.dtype, device=point.device)


def _largest(covariance: Tensor) -> Tensor:
    """Along the axis where it is largest; NaN where a covariance is not finite."""
    finite = covariance.isfinite().all(-1).all(-1)
    safe = torch.where(finite[..., None, None], covariance, 0.0)
    deviation = torch.linalg.eigvalsh(safe)[..., -1].clamp(min=0.0).sqrt()
    return torch.where(finite, deviation, torch.nan)
