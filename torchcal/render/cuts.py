"""Where silhouettes cross the rows and columns of pixel centres."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.model.scene import Surface
from torchcal.render.silhouette import Pieces, silhouette_pieces


@dataclass(frozen=True, kw_only=True, slots=True)
class Cuts:
    """Silhouettes at rows (``along_u``) or columns of pixel centres."""

    view: Int[Tensor, " cut"]
    edge: Int[Tensor, " cut"]
    apex: Int[Tensor, " cut"]
    """A vertex on the side of the edge on which the surface is."""
    place: Float[Tensor, "cut 2"]
    """Pixel coordinates (u, v); one of them is whole."""
    along_u: Bool[Tensor, " cut"]

    @property
    def axis(self) -> Int[Tensor, "cut 2"]:
        """Step (u, v) of one pixel along the row or column."""
        return torch.stack([self.along_u, ~self.along_u], -1).long()

    def select(self, keep: Bool[Tensor, " cut"]) -> "Cuts":
        """The cuts to keep."""
        return Cuts(
            view=self.view[keep],
            edge=self.edge[keep],
            apex=self.apex[keep],
            place=self.place[keep],
            along_u=self.along_u[keep],
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class EdgePlanes:
    """The planes through the sensor that hold the edges of cuts."""

    first: Float[Tensor, "cut 3"]
    """One end of the edge (m)."""
    last: Float[Tensor, "cut 3"]
    normal: Float[Tensor, "cut 3"]
    """Not normalised."""

    @staticmethod
    def of(cuts: Cuts, vertices: Float[Tensor, "vertex 3"], surface: Surface) -> "EdgePlanes":
        """The planes of the cut edges; vertices in the sensor's frame (m)."""
        first, last = vertices[surface.edges[cuts.edge]].unbind(1)
        return EdgePlanes(first=first, last=last, normal=torch.linalg.cross(first, last - first))


def find_cuts(
    vertices: Float[Tensor, "vertex 3"], surface: Surface, projection: Projection, views: int
) -> Cuts:
    """All cuts between two pixel centres of one view; vertices in the sensor's frame (m).

    A steep silhouette is cut with every row of pixel centres, a flat one with every column. Each of
    the ``views`` has the same number of edges of the surface.
    """
    edges_of_view = max(len(surface.edges) // max(views, 1), 1)
    cuts = _cut(silhouette_pieces(vertices, surface, projection), projection, edges_of_view)
    # Onto the true edge, which is curved in a spherical image.
    place, _ = newton_step(cuts, EdgePlanes.of(cuts, vertices, surface).normal, projection)
    cuts = replace(cuts, place=place)
    return cuts.select(_between_centres(cuts, projection))


def newton_step(
    cuts: Cuts, normal: Float[Tensor, "cut 3"], projection: Projection
) -> tuple[Float[Tensor, "cut 2"], Float[Tensor, " cut"]]:
    """Solves normal . ray = 0 along each row or column, from the cut's place.

    Returns:
        The place after one step; the derivative (pixels) of the place to ``normal . ray``.
    """
    ray = projection.rays(cuts.place[:, 0], cuts.place[:, 1])
    to_u, to_v = projection.ray_derivatives(cuts.place[:, 0], cuts.place[:, 1])
    along = torch.where(cuts.along_u[:, None], to_u, to_v)
    rate = -1.0 / (normal.detach() * along).sum(-1)
    return cuts.place + ((normal * ray).sum(-1) * rate)[:, None] * cuts.axis, rate


def _cut(pieces: Pieces, projection: Projection, edges_of_view: int) -> Cuts:
    """Cuts each piece with the rows or columns that it crosses; its lower end is left out."""
    delta = pieces.end - pieces.start
    along_u = delta[:, 1].abs() >= delta[:, 0].abs()
    main = along_u.long()[:, None]
    begin, end = pieces.start.gather(1, main)[:, 0], pieces.end.gather(1, main)[:, 0]
    piece, line = _whole_numbers_between(
        begin, end, torch.where(along_u, projection.height, projection.width)
    )
    line = line.to(begin)
    share = (line - begin[piece]) / (end - begin)[piece]
    place = pieces.start[piece] + share[:, None] * delta[piece]
    along_u = along_u[piece]
    on_line = torch.stack([along_u, ~along_u], -1)
    edge = pieces.edge[piece]
    return Cuts(
        view=edge // edges_of_view,
        edge=edge,
        apex=pieces.apex[piece],
        place=torch.where(on_line, place, line[:, None]),
        along_u=along_u,
    )


def _whole_numbers_between(begin: Tensor, end: Tensor, size: Tensor) -> tuple[Tensor, Tensor]:
    """Pairs (item, number): all whole numbers from 0 to before ``size`` in each half-open span."""
    low, high = torch.minimum(begin, end), torch.maximum(begin, end)
    first = (low.floor().long() + 1).clamp(min=0)
    last = torch.minimum(high.floor().long(), size - 1)
    count = (last - first + 1).clamp(min=0)
    item = torch.repeat_interleave(count)
    order = torch.arange(len(item), device=count.device) - (count.cumsum(0) - count)[item]
    return item, first[item] + order


def _between_centres(cuts: Cuts, projection: Projection) -> Tensor:
    """Cuts that lie between two pixel centres of the image."""
    size = torch.tensor([projection.width, projection.height], device=cuts.place.device)
    low = cuts.place.floor()
    return ((low >= 0) & (low + cuts.axis < size)).all(-1)
