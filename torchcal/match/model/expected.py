"""The elements of a model that a sensor is expected to see from about a pose."""

from dataclasses import dataclass, fields, replace
from typing import TypeVar

import torch
from jaxtyping import Int
from torch import Tensor

from torchcal.match.elements import Elements
from torchcal.match.features import Features, Lines, Planes, Vertices
from torchcal.match.model.features import ModelFeatures
from torchcal.match.model.visibility import Seen

Part = TypeVar("Part", Planes, Lines, Vertices)


@dataclass(frozen=True, kw_only=True, slots=True)
class Expected:
    """Some elements of a model, and which they are."""

    features: Features
    """Kinds, lengths and areas are the model's, not those that are seen; the numbers of planes and
    lines in it are its own. Limbs that are seen come after the lines."""
    planes: Int[Tensor, " plane"]
    """The model's plane of each."""
    lines: Int[Tensor, " line"]
    """The model's line of each; limbs count on after the lines."""
    vertices: Int[Tensor, " vertex"]
    """The model's vertex of each."""


def expected_features(model: ModelFeatures, seen: Seen, *, pixels: float) -> Expected:
    """Planes, lines, limbs and vertexes that are seen.

    Args:
        model: In the world's frame.
        seen: From about where the sensor is.
        pixels: The least length of a line, and side of the square of the least plane, in the image.
    """
    planes = (seen.plane_pixels >= pixels**2).nonzero()[:, 0]
    straight, limbs = (part.pixels >= pixels for part in (seen.lines, seen.limbs))
    corner = straight[model.features.vertices.lines].all(1)
    vertices = corner.nonzero()[:, 0]
    lines = torch.cat([straight, limbs]).nonzero()[:, 0]
    features = model.features
    own_planes = _numbers(planes, len(features.planes.area))
    own_lines = _numbers(lines, len(straight) + len(limbs))
    kept_lines = _rows(_joined(features.lines, model.limbs), lines)
    kept_vertices = _rows(features.vertices, vertices)
    return Expected(
        features=Features(
            planes=_rows(features.planes, planes),
            lines=replace(kept_lines, planes=own_planes[kept_lines.planes]),
            vertices=replace(kept_vertices, lines=own_lines[kept_vertices.lines]),
        ),
        planes=planes,
        lines=lines,
        vertices=vertices,
    )


def _numbers(rows: Tensor, count: int) -> Tensor:
    """The new number of each old one, -1 for those left out and for -1."""
    new = torch.arange(len(rows), device=rows.device)
    return torch.full((count + 1,), -1, device=rows.device).index_put((rows,), new)


def _rows(part: Part, rows: Tensor) -> Part:
    """Some elements with all that is said of them."""
    taken = {}
    for field in fields(part):
        values = getattr(part, field.name)
        if isinstance(values, tuple):
            taken[field.name] = tuple(values[row] for row in rows.tolist())
        else:
            taken[field.name] = values[rows]
    return replace(part, **taken)


def _joined(one: Lines, two: Lines) -> Lines:
    joined = {
        field.name: torch.cat([getattr(one, field.name), getattr(two, field.name)])
        for field in fields(one)
        if field.name != "elements"
    }
    return Lines(elements=Elements.join(one.elements, two.elements), **joined)
