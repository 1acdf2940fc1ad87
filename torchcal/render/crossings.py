"""How much of a pixel lies beyond a silhouette.

Between the centres of two neighbouring pixels the surface changes at the silhouette and not
half-way, as the hard z-buffer says, so the strip between the two moves from one surface to the
other. For a straight edge this is the exact area in every row; it is symmetric about the edge and
leaves no seam inside a face.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.model.scene import Surface
from torchcal.render.cuts import Cuts, EdgePlanes, find_cuts, newton_step
from torchcal.render.facets import Facets

ON_CENTRE = 1e-3
"""Pixels from a centre within which rounding may have put it on the other side of an edge."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Crossings:
    """Strips of pixels, between a silhouette and the pixel's border."""

    view: Int[Tensor, " crossing"]
    pixel: Int[Tensor, "crossing 2"]
    """The pixel (u, v) whose area is shared."""
    step: Int[Tensor, "crossing 2"]
    """The step (u, v) of one pixel from the pixel's centre across the silhouette."""
    own_face: Int[Tensor, " crossing"]
    """The face that fills the pixel on this side of the silhouette; -1 where the model is empty."""
    other_face: Int[Tensor, " crossing"]
    """The face beyond the silhouette; -1 where the model is empty."""
    gap: Float[Tensor, " crossing"]
    """Distance (pixels) from the pixel's centre to the silhouette, 0 to 1/2."""
    gap_derivative: Float[Tensor, "crossing 6"]
    """Derivative of ``gap`` to the motion of the edge, a twist in the sensor's frame (m, rad)."""
    body: Int[Tensor, " crossing"]
    """The body that the edge belongs to."""
    sign: Int[Tensor, " crossing"]
    """1; -1 where the strip is taken from the other face: it is too thin to meet a centre."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Sides:
    """The two pixels between whose centres each cut lies."""

    near_pixel: Int[Tensor, "cut 2"]
    """The pixel (u, v) on the silhouette's own side."""
    near_face: Int[Tensor, " cut"]
    """The face that ends at the cut."""
    near_pixel_face: Int[Tensor, " cut"]
    """The face at the near pixel's centre: another one where the part up to it is thin."""
    far_pixel: Int[Tensor, "cut 2"]
    far_face: Int[Tensor, " cut"]

    def select(self, keep: Tensor) -> "_Sides":
        return _Sides(
            near_pixel=self.near_pixel[keep],
            near_face=self.near_face[keep],
            near_pixel_face=self.near_pixel_face[keep],
            far_pixel=self.far_pixel[keep],
            far_face=self.far_face[keep],
        )


def find_crossings(
    vertices: Float[Tensor, "vertex 3"],
    surface: Surface,
    facets: Facets,
    face_image: Int[Tensor, "view h w"],
    projection: Projection,
) -> Crossings:
    """The crossings of all silhouettes that are seen in a batch of views.

    Args:
        vertices: Points (m) in the sensor's frame of their view.
        surface: The triangles of all views, see ``soup.py``.
        facets: Their planes.
        face_image: The face at the centre of every pixel.
        projection: The sensor's optics.
    """
    cuts = find_cuts(vertices.detach(), surface, projection, len(face_image))
    sides = _sides(cuts, vertices.detach(), surface, face_image, projection)
    whole, thin = _seen(cuts, sides, vertices.detach(), surface, facets, projection)
    front = _front_faces(cuts, sides, surface, facets, projection)
    sides = replace(sides, near_face=torch.where(thin, front, sides.near_face))
    cuts, sides = cuts.select(whole | thin), sides.select(whole | thin)
    outermost = _outermost(cuts, sides, face_image)
    cuts, sides = cuts.select(outermost), sides.select(outermost)
    planes = EdgePlanes.of(cuts, vertices, surface)
    place, rate = newton_step(cuts, planes.normal, projection)
    derivative = _place_derivative(cuts, planes, rate, projection)
    crossings = _crossings(cuts, sides, place, derivative, surface)
    return _without_slivers(crossings, facets, face_image, projection)


def _sides(
    cuts: Cuts, vertices: Tensor, surface: Surface, face_image: Tensor, projection: Projection
) -> _Sides:
    low = cuts.place.floor().long()
    high = low + cuts.axis
    normal = EdgePlanes.of(cuts, vertices, surface).normal
    own_side = (normal * vertices[cuts.apex]).sum(-1)
    # The lower pixel's centre may lie on the edge, the higher one's does not.
    high_side = (normal * projection.rays(*high.to(vertices).unbind(-1))).sum(-1)
    near_is_low = (own_side.sign() != high_side.sign())[:, None]
    near, far = torch.where(near_is_low, low, high), torch.where(near_is_low, high, low)
    near_face = face_image[cuts.view, near[:, 1], near[:, 0]]
    return _Sides(
        near_pixel=near,
        near_face=near_face,
        near_pixel_face=near_face,
        far_pixel=far,
        far_face=face_image[cuts.view, far[:, 1], far[:, 0]],
    )


def _seen(
    cuts: Cuts,
    sides: _Sides,
    vertices: Tensor,
    surface: Surface,
    facets: Facets,
    projection: Projection,
) -> tuple[Tensor, Tensor]:
    """Whether the near side's surface ends at the edge; whether both sides' lie behind it.

    Where a surface ends, the edge is nearer to it than to the far side's, which asks for no
    tolerance in metres. Where both lie behind, the edge belongs to a part that is too thin to meet
    a pixel's centre there.
    """
    ray = projection.rays(*cuts.place.unbind(-1))
    edge_range = projection.ranges(_points_on_edges(EdgePlanes.of(cuts, vertices, surface), ray))
    near = facets.ranges(sides.near_face, ray).detach()
    near = torch.where(sides.near_face < 0, torch.inf, near)
    far = facets.ranges(sides.far_face, ray).detach()
    jump = torch.where(sides.far_face < 0, torch.inf, far) - edge_range
    tolerance = torch.minimum(0.5 * jump, 0.1 * edge_range)
    whole = (near - edge_range).abs() < tolerance
    # At a centre rounding decides on which side it lies: nothing there is thin.
    gap = ((cuts.place - sides.near_pixel) * cuts.axis).sum(-1).abs()
    thin = (near - edge_range >= tolerance) & (gap > ON_CENTRE) & (gap < 1 - ON_CENTRE)
    return whole & (jump > 0), thin & (jump > 0)


def _front_faces(
    cuts: Cuts, sides: _Sides, surface: Surface, facets: Facets, projection: Projection
) -> Tensor:
    """The one of each edge's two faces that is seen: it is the nearer one beside the edge."""
    place = cuts.place + 0.25 * (sides.near_pixel - cuts.place)
    ray = projection.rays(place[:, 0], place[:, 1])
    first, second = surface.edge_faces[cuts.edge].unbind(-1)
    nearer = facets.ranges(second, ray) < facets.ranges(first, ray)
    return torch.where((second >= 0) & nearer, second, first)


def _outermost(cuts: Cuts, sides: _Sides, face_image: Tensor) -> Tensor:
    """Of the cuts between the same two centres with the same near side, the one at the far end.

    The near surface reaches as far as its last edge; the edges before it lie on or behind it.
    """
    gap = ((cuts.place - sides.near_pixel) * cuts.axis).sum(-1).abs()
    height, width = face_image.shape[1:]
    row = cuts.view * height + sides.near_pixel[:, 1]
    near = row * width + sides.near_pixel[:, 0]
    forward = (sides.far_pixel - sides.near_pixel).sum(-1) > 0
    strip = 4 * near + 2 * cuts.along_u.long() + forward.long()
    order = torch.arange(len(gap), device=gap.device)
    # Positive floats sort like their bits: one number holds the gap and, for ties, the cut.
    key = (gap.float().view(torch.int32).long() << 32) | order
    last = key.new_zeros(4 * face_image.numel()).scatter_reduce_(0, strip, key, "amax")
    return last[strip] == key


def _points_on_edges(planes: EdgePlanes, ray: Tensor) -> Tensor:
    """The point (m) of each edge's line that is nearest to the ray."""
    direction = planes.last - planes.first
    along = torch.linalg.cross(direction, ray)
    across = torch.linalg.cross(planes.first, ray)
    share = -(across * along).sum(-1) / along.square().sum(-1)
    return planes.first + share[:, None] * direction


def _place_derivative(
    cuts: Cuts, planes: EdgePlanes, rate: Tensor, projection: Projection
) -> Tensor:
    """Derivative of the place along the row or column (pixels) to a twist of the edge."""
    ray = projection.rays(*cuts.place.unbind(-1))
    point = _points_on_edges(planes, ray)
    pulled = torch.cat([planes.normal, torch.linalg.cross(point, planes.normal)], -1)
    scale = -rate * ray.square().sum(-1) / (point * ray).sum(-1)
    return scale[:, None] * pulled


def _crossings(
    cuts: Cuts, sides: _Sides, place: Tensor, place_derivative: Tensor, surface: Surface
) -> Crossings:
    """Each strip belongs to the pixel whose centre is nearer to the cut."""
    to_near = ((cuts.place - sides.near_pixel) * cuts.axis).sum(-1).abs()
    in_near = to_near < 0.5
    pixel = torch.where(in_near[:, None], sides.near_pixel, sides.far_pixel)
    step = torch.where(in_near[:, None], sides.far_pixel, sides.near_pixel) - pixel
    forward = (step * cuts.axis).sum(-1)
    thin = sides.near_face != sides.near_pixel_face
    own_face = torch.where(in_near, sides.near_pixel_face, sides.far_face)
    reaching = torch.where(in_near & ~thin, sides.far_face, sides.near_face)
    return Crossings(
        view=cuts.view,
        pixel=pixel,
        step=step,
        own_face=own_face,
        other_face=reaching,
        gap=((place - pixel) * step).sum(-1),
        gap_derivative=forward[:, None] * place_derivative,
        body=surface.vertex_body[surface.edges[cuts.edge, 0]],
        sign=torch.where(in_near & thin, -1, 1),
    )


def _without_slivers(
    crossings: Crossings, facets: Facets, face_image: Tensor, projection: Projection
) -> Crossings:
    """Where the pixel's own face is seen edge-on, the face of the pixel behind fills its part.

    A face that rises more to the middle of the part than to the next pixel's surface, four times as
    far away, ends before that.
    """
    pixel, own = crossings.pixel, crossings.own_face
    size = torch.tensor([projection.width, projection.height], device=pixel.device)
    back = torch.minimum((pixel - crossings.step).clamp(min=0), size - 1)
    behind = face_image[crossings.view, back[:, 1], back[:, 0]]
    offset = 0.5 * (crossings.gap.detach() - 0.5)[:, None]
    middle = _ranges_at(own, pixel + offset * crossings.step, facets, projection)
    centre = _ranges_at(own, pixel.to(middle), facets, projection)
    next_one = _ranges_at(behind, back.to(middle), facets, projection)
    too_steep = (middle - centre).abs() > (next_one - centre).abs()
    replaced = too_steep & (behind >= 0) & (own >= 0)
    return replace(crossings, own_face=torch.where(replaced, behind, own))


def _ranges_at(face: Tensor, place: Tensor, facets: Facets, projection: Projection) -> Tensor:
    return facets.ranges(face, projection.rays(place[:, 0], place[:, 1])).detach()
