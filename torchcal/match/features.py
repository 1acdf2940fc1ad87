"""Elements with their characteristic values (3.1 (2), 3.2): of a range image or of a model.

Both sides speak of the same things in the same units, so eq. 6 can compare them. A value that an
image cannot tell is NaN, and its standard deviation infinite.
"""

from dataclasses import dataclass, fields, replace
from enum import IntEnum
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.match.elements import Elements


class LineKind(IntEnum):
    """How the surfaces beside a line meet."""

    CONVEX = 0
    """A crease that points to the sensor's side."""
    CONCAVE = 1
    JUMP = 2
    """The range jumps: the line bounds the nearer surface."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Planes:
    """Flat parts of surfaces."""

    elements: Elements
    area: Float[Tensor, " plane"]
    """m^2 that are seen, or of the model's whole face."""
    area_sigma: Float[Tensor, " plane"]
    outline: tuple[Float[Tensor, "_ 3"], ...]
    """The corners (m) of each plane's outer border, in order."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Lines:
    """Straight edges."""

    elements: Elements
    ends: Float[Tensor, "line 2 3"]
    """m"""
    is_end: Bool[Tensor, "line 2"]
    """Whether the edge ends there, and is not cut by the image's border or hidden."""
    length_sigma: Float[Tensor, " line"]
    """Of the distance between the ends (m)."""
    kind: Int[Tensor, " line"]
    """One ``LineKind`` each."""
    dihedral: Float[Tensor, " line"]
    """Angle (rad) between the normals beside it: 0 is flat; NaN where one side is not seen."""
    dihedral_sigma: Float[Tensor, " line"]
    planes: Int[Tensor, "line 2"]
    """The planes beside it; -1 where there is none."""

    @property
    def length(self) -> Float[Tensor, " line"]:
        """Between the ends (m)."""
        return (self.ends[:, 1] - self.ends[:, 0]).norm(dim=-1)


@dataclass(frozen=True, kw_only=True, slots=True)
class Vertices:
    """Points where three lines or more meet."""

    elements: Elements
    lines: Int[Tensor, "vertex 3"]
    angles: Float[Tensor, "vertex 3"]
    """Between every two of the lines (rad), in ascending order."""
    angles_sigma: Float[Tensor, "vertex 3"]


@dataclass(frozen=True, kw_only=True, slots=True)
class Features:
    """All elements of one range image, in the sensor's frame, or of one model."""

    planes: Planes
    lines: Lines
    vertices: Vertices

    def to(self, device: str | torch.device) -> "Features":
        """On another device."""
        return Features(
            planes=_on(self.planes, device),
            lines=_on(self.lines, device),
            vertices=_on(self.vertices, device),
        )


Part = TypeVar("Part", Planes, Lines, Vertices)


def _on(part: Part, device: str | torch.device) -> Part:
    moved = {}
    for field in fields(part):
        values = getattr(part, field.name)
        several = isinstance(values, tuple)
        moved[field.name] = (
            tuple(each.to(device) for each in values) if several else values.to(device)
        )
    return replace(part, **moved)
