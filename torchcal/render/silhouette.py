"""Silhouettes: the edges at which the surface ends in the image, as pieces that are straight there.

A silhouette is an edge whose two faces lie on the same side of it in the image, or the border of an
open mesh. This does not ask which way the faces are wound.
"""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection, Spherical
from torchcal.model.scene import Surface
from torchcal.render.facets import dot

CLOSE = 1e-6
"""Edges are clipped at this depth (m) before a pinhole."""
ARC = 8.0
"""Longest piece (pixels) of an edge that is taken as straight in a spherical image."""
NEAREST = 0.05
"""The chord between the directions of an edge's ends is not taken as nearer to the sensor than this
(of 1): it bounds the pieces of an edge that all but touches the sensor."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Pieces:
    """Pieces of silhouette edges in one image."""

    edge: Int[Tensor, " piece"]
    apex: Int[Tensor, " piece"]
    """The third vertex of a face of the edge: it tells on which side the surface is."""
    start: Float[Tensor, "piece 2"]
    """Pixel coordinates (u, v)."""
    end: Float[Tensor, "piece 2"]


def silhouette_pieces(
    vertices: Float[Tensor, "vertex 3"], surface: Surface, projection: Projection
) -> Pieces:
    """The silhouettes of one view that may cross its image; vertices in the sensor's frame (m)."""
    edge, apex = _silhouettes(vertices, surface)
    first, last = vertices[surface.edges[edge]].unbind(1)
    cut = _split if isinstance(projection, Spherical) else _clip
    first, last, piece = cut(first, last, projection)
    start, end = projection.pixels(first), projection.pixels(last)
    keep = torch.nonzero(_reaches_image(start, end, projection))[:, 0]
    piece = piece[keep]
    return Pieces(edge=edge[piece], apex=apex[piece], start=start[keep], end=end[keep])


def _reaches_image(start: Tensor, end: Tensor, projection: Projection) -> Tensor:
    size = torch.tensor([projection.width, projection.height], device=start.device)
    low, high = torch.minimum(start, end), torch.maximum(start, end)
    inside = ((high > -1) & (low < size)).all(-1) & low.isfinite().all(-1) & high.isfinite().all(-1)
    if isinstance(projection, Spherical):
        # A piece over the seam of the azimuth seems to span the whole turn.
        inside &= (high - low)[:, 0] * abs(projection.azimuth_step) < math.pi
    return inside


def _silhouettes(vertices: Tensor, surface: Surface) -> tuple[Tensor, Tensor]:
    """Silhouette edges and for each a vertex on its own side."""
    first, last = (vertices.index_select(0, end) for end in surface.edges.unbind(1))
    plane = torch.linalg.cross(first, last - first)
    apexes, sides = zip(*(_beside(k, plane, vertices, surface) for k in (0, 1)), strict=True)
    border = surface.edge_faces[:, 1] < 0
    edge = torch.nonzero(border | (sides[0] * sides[1] > 0))[:, 0]
    return edge, apexes[0][edge]


def _beside(k: int, plane: Tensor, vertices: Tensor, surface: Surface) -> tuple[Tensor, Tensor]:
    """The corner opposite to each edge in its ``k``-th face; on which side of the edge it is."""
    face = surface.faces.index_select(0, surface.edge_faces[:, k].clamp(min=0))
    apex = face[:, 0] + face[:, 1] + face[:, 2] - surface.edges[:, 0] - surface.edges[:, 1]
    apex = apex.where(surface.edge_faces[:, k] >= 0, surface.edges[:, 0])
    return apex, dot(plane, vertices.index_select(0, apex)).sign()


def _clip(first: Tensor, last: Tensor, _: Projection) -> tuple[Tensor, Tensor, Tensor]:
    """The parts of edges before a pinhole."""
    piece = torch.nonzero((first[:, 2] > CLOSE) | (last[:, 2] > CLOSE))[:, 0]
    first, last = first[piece], last[piece]

    def pulled(a: Tensor, b: Tensor) -> Tensor:
        share = ((CLOSE - a[:, 2]) / (b[:, 2] - a[:, 2])).clamp(0, 1)[:, None]
        return torch.where(a[:, 2:] > CLOSE, a, a + share.nan_to_num(0.0) * (b - a))

    return pulled(first, last), pulled(last, first), piece


def _split(first: Tensor, last: Tensor, projection: Projection) -> tuple[Tensor, Tensor, Tensor]:
    """Edges cut into pieces of at most ``ARC`` pixels, by directions only: their length is free."""
    assert isinstance(projection, Spherical)
    step = min(abs(projection.azimuth_step), abs(projection.elevation_step)) or 1.0
    a, b = (torch.nn.functional.normalize(end, dim=-1) for end in (first, last))
    # Equal lengths on the chord are unequal angles: they are widest where it is nearest.
    nearest = (0.5 * (a + b).norm(dim=-1)).clamp(min=NEAREST)
    count = ((b - a).norm(dim=-1) / (nearest * ARC * step)).nan_to_num().ceil().clamp(min=1).long()
    piece = torch.repeat_interleave(count)
    order = torch.arange(len(piece), device=count.device) - (count.cumsum(0) - count)[piece]

    def place(order: Tensor) -> Tensor:
        """On the chord; a piece ends, to the last bit, where the next one starts."""
        return a[piece] + (order / count[piece])[:, None].to(a) * (b - a)[piece]

    return place(order), place(order + 1), piece
