"""Edges that the image shows as borders, and the strokes that they leave in it.

A silhouette is an edge whose two faces lie on the same side of it in the image, or the border of an
open mesh: the range jumps there. At a crease both faces may be seen, and the range bends. This does
not ask which way the faces are wound.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection, Spherical
from torchcal.model.scene import Surface
from torchcal.render.boxes import are_beside
from torchcal.render.facets import Facets, dot
from torchcal.render.soup import Views

CLOSE = 1e-6
"""Strokes of edges are clipped at this depth (m) before a pinhole."""
ARC = 4.0
"""Longest stroke (pixels) that is taken as straight, but for its margin, in a spherical image."""
NEAREST = 0.05
"""The chord between the directions of an edge's ends is not taken as nearer to the sensor than this
(of 1): it bounds the strokes of an edge that all but touches the sensor."""
BEND = 2e-5
"""Share of the range: creases that change no pixel's mean by more are left out."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Borders:
    """Edges of the surface at which the range may jump or bend."""

    edge: Int[Tensor, " border"]
    jumps: Bool[Tensor, " border"]
    """Silhouettes; the others are creases."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Strokes:
    """What lines in space leave in the image: straight lines, but for a margin."""

    line: Int[Tensor, " stroke"]
    start: Float[Tensor, "stroke 2"]
    """Pixel coordinates (u, v)."""
    end: Float[Tensor, "stroke 2"]
    margin: Float[Tensor, " stroke"]
    """Pixels by which it may leave the straight line."""


def borders_of(views: Views) -> Borders:
    """Silhouettes, and creases that matter, of all views."""
    vertices, surface, projection = views.vertices, views.surface, views.sensor.projection
    first, last = (vertices.index_select(0, end) for end in surface.edges.unbind(1))
    plane = torch.linalg.cross(first, last - first)
    sides = [_side(k, plane, vertices, surface) for k in (0, 1)]
    open_border = surface.edge_faces[:, 1] < 0
    jumps = open_border | (sides[0] * sides[1] > 0)
    far = torch.maximum(projection.ranges(first).abs(), projection.ranges(last).abs())
    # In a pixel's own mean a crease through its middle changes an eighth of this.
    bend = (
        _inverse_bend(surface, Facets.of(vertices, surface.faces)) * far * _pixel_size(projection)
    )
    bends = bend > 8.0 * BEND
    edge = torch.nonzero(jumps | (bends & ~open_border))[:, 0]
    return Borders(edge=edge, jumps=jumps[edge])


def strokes_of(lines: Float[Tensor, "line 2 3"], projection: Projection) -> Strokes:
    """The strokes of lines between two points (m) that may cross the image."""
    first, last, line = (_split if isinstance(projection, Spherical) else _clip)(lines, projection)
    start, end = projection.pixels(first), projection.pixels(last)
    margin = 2.0 * (projection.pixels(first + last) - 0.5 * (start + end)).norm(dim=-1) + 1e-6
    if not isinstance(projection, Spherical):
        margin = torch.full_like(margin, 1e-6)
    keep = torch.nonzero(_reaches_image(start, end, margin, projection))[:, 0]
    return Strokes(line=line[keep], start=start[keep], end=end[keep], margin=margin[keep])


def _side(k: int, plane: Tensor, vertices: Tensor, surface: Surface) -> Tensor:
    """On which side of each edge the third corner of its ``k``-th face is."""
    face = surface.faces.index_select(0, surface.edge_faces[:, k].clamp(min=0))
    apex = face[:, 0] + face[:, 1] + face[:, 2] - surface.edges[:, 0] - surface.edges[:, 1]
    apex = apex.where(surface.edge_faces[:, k] >= 0, surface.edges[:, 0])
    return dot(plane, vertices.index_select(0, apex)).sign()


def _inverse_bend(surface: Surface, facets: Facets) -> Tensor:
    """How much the gradient of 1 / range to the ray differs between both faces of each edge."""
    gradients = []
    for face in surface.edge_faces.clamp(min=0).unbind(1):
        offset = facets.offset.index_select(0, face)[:, None]
        gradients.append(facets.normal.index_select(0, face) / offset)
    return (gradients[0] - gradients[1]).norm(dim=-1).nan_to_num(torch.inf)


def _pixel_size(projection: Projection) -> float:
    """Length of the step (m at 1 m) from pixel to pixel in the middle of the image."""
    middle = torch.tensor([projection.width / 2, projection.height / 2], dtype=torch.float64)
    return max(float(step.norm()) for step in projection.ray_derivatives(*middle))


def _reaches_image(start: Tensor, end: Tensor, margin: Tensor, projection: Projection) -> Tensor:
    size = torch.tensor([projection.width, projection.height], device=start.device)
    low, high = torch.minimum(start, end), torch.maximum(start, end)
    low, high = low - margin[:, None], high + margin[:, None]
    inside = ((high > -0.5) & (low < size - 0.5)).all(-1)
    inside &= low.isfinite().all(-1) & high.isfinite().all(-1)
    if isinstance(projection, Spherical):
        # A stroke over the seam of the azimuth seems to span the whole turn.
        inside &= (end - start)[:, 0].abs() * abs(projection.azimuth_step) < math.pi
    return inside


def _clip(lines: Tensor, _: Projection) -> tuple[Tensor, Tensor, Tensor]:
    """The parts of edges before a pinhole."""
    first, last = lines.unbind(1)
    border = torch.nonzero((first[:, 2] > CLOSE) | (last[:, 2] > CLOSE))[:, 0]
    first, last = first[border], last[border]

    def pulled(a: Tensor, b: Tensor) -> Tensor:
        share = ((CLOSE - a[:, 2]) / (b[:, 2] - a[:, 2])).clamp(0, 1)[:, None]
        return torch.where(a[:, 2:] > CLOSE, a, a + share.nan_to_num(0.0) * (b - a))

    return pulled(first, last), pulled(last, first), border


def _split(lines: Tensor, projection: Projection) -> tuple[Tensor, Tensor, Tensor]:
    """Edges cut into strokes of at most ``ARC`` pixels, by directions: their length is free."""
    assert isinstance(projection, Spherical)
    near = torch.nonzero(~are_beside(lines, projection))[:, 0]
    first, last = lines[near].unbind(1)
    step = min(abs(projection.azimuth_step), abs(projection.elevation_step)) or 1.0
    a, b = (torch.nn.functional.normalize(end, dim=-1) for end in (first, last))
    # Equal lengths on the chord are unequal angles: they are widest where it is nearest.
    nearest = (0.5 * (a + b).norm(dim=-1)).clamp(min=NEAREST)
    count = ((b - a).norm(dim=-1) / (nearest * ARC * step)).nan_to_num().ceil().clamp(min=1).long()
    border = torch.repeat_interleave(count)
    order = torch.arange(len(border), device=count.device) - (count.cumsum(0) - count)[border]

    def place(order: Tensor) -> Tensor:
        """On the chord; a stroke ends, to the last bit, where the next one starts."""
        return a[border] + (order / count[border])[:, None].to(a) * (b - a)[border]

    return place(order), place(order + 1), near[border]
