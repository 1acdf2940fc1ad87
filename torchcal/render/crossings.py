"""How much of a pixel lies beyond a silhouette.

A steep silhouette is cut with every row of pixel centres, a flat one with every column. Between the
centres of two neighbouring pixels the surface changes at the cut and not half-way, as the hard
z-buffer says, so the strip between the two moves from one surface to the other. For a straight edge
this is the exact area in every row; it is symmetric about the edge and leaves no seam inside a face.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.model.scene import Surface
from torchcal.render.facets import Facets
from torchcal.render.silhouette import Pieces, silhouette_pieces


@dataclass(frozen=True, kw_only=True, slots=True)
class Crossings:
    """Cuts of visible silhouettes between the centres of two pixels, of one view."""

    near_face: Int[Tensor, " crossing"]
    """The face on the silhouette's own side."""
    far_face: Int[Tensor, " crossing"]
    """The face beyond; -1 where the model is empty."""
    near_pixel: Int[Tensor, "crossing 2"]
    """The pixel (u, v) on the silhouette's own side."""
    step: Int[Tensor, "crossing 2"]
    """The step (u, v) of one pixel across the silhouette."""
    gap: Float[Tensor, " crossing"]
    """Distance (pixels) from the centre of ``near_pixel`` to the silhouette, 0 to 1."""
    gap_derivative: Float[Tensor, "crossing 6"]
    """Derivative of ``gap`` to the motion of the edge, a twist in the sensor's frame (m, rad)."""
    body: Int[Tensor, " crossing"]
    """The body that the edge belongs to."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Cuts:
    """Cuts of silhouettes with rows (``along_u``) or columns of pixel centres."""

    edge: Int[Tensor, " cut"]
    apex: Int[Tensor, " cut"]
    place: Float[Tensor, "cut 2"]
    along_u: Bool[Tensor, " cut"]

    def select(self, keep: Tensor) -> "_Cuts":
        return _Cuts(
            edge=self.edge[keep],
            apex=self.apex[keep],
            place=self.place[keep],
            along_u=self.along_u[keep],
        )

    @property
    def axis(self) -> Tensor:
        """Unit step (u, v) along the row or column."""
        return torch.stack([self.along_u, ~self.along_u], -1).long()


def find_crossings(
    vertices: Float[Tensor, "vertex 3"],
    surface: Surface,
    facets: Facets,
    face_image: Int[Tensor, "h w"],
    projection: Projection,
) -> Crossings:
    """The cuts of all silhouettes that are seen in one view; vertices in the sensor's frame (m)."""
    cuts = _cut(silhouette_pieces(vertices.detach(), surface, projection), projection)
    cuts = _sharpened(cuts, vertices.detach(), surface, projection)
    cuts = cuts.select(_between_centres(cuts, projection))
    first, last = vertices[surface.edges[cuts.edge]].unbind(1)
    plane = torch.linalg.cross(first, last - first)
    place, gap_per_plane = _newton_step(cuts, plane, projection)
    low = cuts.place.floor().long()
    ray_low = projection.rays(low[:, 0].to(place), low[:, 1].to(place))
    own_side = (plane * vertices[cuts.apex]).sum(-1).sign()
    near_is_low = (plane * ray_low).sum(-1).sign() == own_side
    step = torch.where(near_is_low[:, None], cuts.axis, -cuts.axis)
    near_pixel = torch.where(near_is_low[:, None], low, low + cuts.axis)
    far_pixel = near_pixel + step
    ray = projection.rays(place[:, 0], place[:, 1]).detach()
    point = _points_on_edges(first, last, ray)
    gap = ((place - near_pixel) * step).sum(-1)
    sign = (cuts.axis * step).sum(-1)
    pulled = torch.cat([plane, torch.linalg.cross(point, plane)], -1)
    scale = -sign * gap_per_plane * (ray.square().sum(-1) / (point * ray).sum(-1))
    crossings = Crossings(
        near_face=face_image[near_pixel[:, 1], near_pixel[:, 0]],
        far_face=face_image[far_pixel[:, 1], far_pixel[:, 0]],
        near_pixel=near_pixel,
        step=step,
        gap=gap,
        gap_derivative=scale[:, None] * pulled,
        body=surface.vertex_body[surface.edges[cuts.edge, 0]],
    )
    return _select(crossings, _is_seen(crossings, facets, ray, projection.ranges(point)))


def _cut(pieces: Pieces, projection: Projection) -> _Cuts:
    """Cuts each piece with the rows or columns that it crosses, the start left out, the end kept."""
    delta = pieces.end - pieces.start
    steep = delta[:, 1].abs() >= delta[:, 0].abs()
    main = steep.long()[:, None]
    a, b = pieces.start.gather(1, main)[:, 0], pieces.end.gather(1, main)[:, 0]
    size = torch.where(steep, projection.height, projection.width)
    first = (torch.minimum(a, b).floor().long() + 1).clamp(min=0)
    last = torch.minimum(torch.maximum(a, b).floor().long(), size - 1)
    count = (last - first + 1).clamp(min=0)
    piece = torch.repeat_interleave(torch.arange(len(count), device=count.device), count)
    order = torch.arange(len(piece), device=count.device) - (count.cumsum(0) - count)[piece]
    line = (first[piece] + order).to(a)
    share = (line - a[piece]) / (b - a)[piece]
    place = pieces.start[piece] + share[:, None] * delta[piece]
    along_u = steep[piece]
    place = torch.where(torch.stack([along_u, ~along_u], -1), place, line[:, None])
    return _Cuts(edge=pieces.edge[piece], apex=pieces.apex[piece], place=place, along_u=along_u)


def _between_centres(cuts: _Cuts, projection: Projection) -> Tensor:
    """Cuts that lie between two pixel centres of the image."""
    size = torch.tensor([projection.width, projection.height], device=cuts.place.device)
    low = cuts.place.floor()
    return ((low >= 0) & (low + cuts.axis < size)).all(-1)


def _sharpened(
    cuts: _Cuts, vertices: Tensor, surface: Surface, projection: Projection
) -> _Cuts:
    """Cuts moved onto the true edge, which is curved in a spherical image."""
    first, last = vertices[surface.edges[cuts.edge]].unbind(1)
    place, _ = _newton_step(cuts, torch.linalg.cross(first, last - first), projection)
    return replace(cuts, place=place)


def _newton_step(cuts: _Cuts, plane: Tensor, projection: Projection) -> tuple[Tensor, Tensor]:
    """Solves plane . ray = 0 along the row or column; with d place / d (plane . ray)."""
    ray = projection.rays(cuts.place[:, 0], cuts.place[:, 1])
    to_u, to_v = projection.ray_derivatives(cuts.place[:, 0], cuts.place[:, 1])
    along = torch.where(cuts.along_u[:, None], to_u, to_v)
    rate = -1.0 / (plane.detach() * along).sum(-1)
    return cuts.place + ((plane * ray).sum(-1) * rate)[:, None] * cuts.axis, rate


def _points_on_edges(first: Tensor, last: Tensor, ray: Tensor) -> Tensor:
    """The point (m) of each edge's line that is nearest to the ray."""
    along = torch.linalg.cross(last - first, ray)
    across = torch.linalg.cross(first, ray)
    share = -(across * along).sum(-1) / along.square().sum(-1)
    return first + share[:, None] * (last - first)


def _is_seen(crossings: Crossings, facets: Facets, ray: Tensor, edge_range: Tensor) -> Tensor:
    """Whether the near side's surface ends at the edge and the far side's lies behind it.

    The edge must be nearer to the near side's surface than to the far side's, which asks for no
    tolerance in metres.
    """
    near = facets.ranges(crossings.near_face, ray)
    far = facets.ranges(crossings.far_face, ray)
    far = torch.where(crossings.far_face < 0, torch.inf, far)
    jump = far - edge_range
    close = (near - edge_range).abs() < torch.minimum(0.5 * jump, 0.1 * edge_range)
    finite = crossings.gap_derivative.isfinite().all(-1) & crossings.gap.isfinite()
    return (crossings.near_face >= 0) & (jump > 0) & close & finite


def _select(crossings: Crossings, keep: Tensor) -> Crossings:
    return Crossings(
        near_face=crossings.near_face[keep],
        far_face=crossings.far_face[keep],
        near_pixel=crossings.near_pixel[keep],
        step=crossings.step[keep],
        gap=crossings.gap[keep],
        gap_derivative=crossings.gap_derivative[keep],
        body=crossings.body[keep],
    )
