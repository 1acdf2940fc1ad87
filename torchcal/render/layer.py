"""Every pixel's own area: filled by what its central ray meets, then shared along silhouettes."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.model.scene import Surface
from torchcal.render.crossings import Crossings
from torchcal.render.facets import Facets


@dataclass(frozen=True, kw_only=True, slots=True)
class Layer:
    """Integrals over each pixel's own area, and their derivatives to the parameters."""

    total: Float[Tensor, "h w"]
    """Of the range (m); the part without a surface counts 0."""
    area: Float[Tensor, "h w"]
    """Of 1 where there is a surface: pixels."""
    total_derivative: Float[Tensor, "parameter h w"]
    area_derivative: Float[Tensor, "parameter h w"]

    def crop(self, rows: slice, columns: slice) -> "Layer":
        """The part in some rows and columns."""
        return Layer(
            total=self.total[rows, columns],
            area=self.area[rows, columns],
            total_derivative=self.total_derivative[:, rows, columns],
            area_derivative=self.area_derivative[:, rows, columns],
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class BodyMotion:
    """How the faces of bodies move with the parameters; bodies that move alike are one kind."""

    kinds: Float[Tensor, "kind 6 parameter"]
    """Twist (m, rad) in the sensor's frame per unit of each parameter."""
    body_kind: Int[Tensor, " body"]
    face_body: Int[Tensor, " face"]

    @staticmethod
    def of(motion: Float[Tensor, "body 6 parameter"], surface: Surface) -> "BodyMotion":
        """Finds the bodies that move alike."""
        face_body = surface.vertex_body[surface.faces[:, 0]]
        if motion.shape[-1] == 0:  # torch.unique knows no rows of length 0
            alike = face_body.new_zeros(len(motion))
            return BodyMotion(kinds=motion[:1], body_kind=alike, face_body=face_body)
        kinds, body_kind = torch.unique(motion, dim=0, return_inverse=True)
        return BodyMotion(kinds=kinds, body_kind=body_kind, face_body=face_body)

    @property
    def parameters(self) -> int:
        """Number of parameters."""
        return self.kinds.shape[-1]

    def of_bodies(
        self, twist_derivative: Float[Tensor, "*batch 6"], body: Int[Tensor, "*batch"]
    ) -> Float[Tensor, "*batch parameter"]:
        """Chain rule from the twist of each row's body to the parameters."""
        result = twist_derivative @ self.kinds[0]
        for i in range(1, len(self.kinds)):
            chosen = (self.body_kind[body] == i)[..., None]
            result = torch.where(chosen, twist_derivative @ self.kinds[i], result)
        return result

    def of_ranges(
        self,
        facets: Facets,
        face: Int[Tensor, "*batch"],
        rays: Float[Tensor, "*batch 3"],
    ) -> Float[Tensor, "*batch parameter"]:
        """Derivative of the ranges at which rays meet faces; 0 for face -1."""
        body = self.face_body[face.clamp(min=0)]
        return self.of_bodies(facets.twist_derivatives(face, rays), body)


@dataclass(frozen=True, kw_only=True, slots=True)
class _Part:
    """A part of each crossing's pixel, by the range in its middle."""

    range: Tensor
    slope: Tensor
    """Derivative of the range to the middle's place."""
    derivative: Tensor
    """Derivative of the range to the parameters, the middle at rest."""


def hard_layer(
    face: Int[Tensor, "h w"],
    facets: Facets,
    rays: Float[Tensor, "h w 3"],
    motion: BodyMotion | None,
) -> Layer:
    """The layer as if every pixel were filled by the face that its central ray meets."""
    total = facets.ranges(face, rays)
    derivative = total.new_zeros(0, *face.shape)
    if motion is not None:
        derivative = motion.of_ranges(facets, face, rays).movedim(-1, 0)
    return Layer(
        total=total,
        area=(face >= 0).to(total),
        total_derivative=derivative,
        area_derivative=torch.zeros_like(derivative),
    )


def soften(
    layer: Layer,
    crossings: Crossings,
    facets: Facets,
    projection: Projection,
    motion: BodyMotion | None,
) -> Layer:
    """Gives the strips beyond the silhouettes to the surfaces that are seen there.

    In the row of a crossing the pixel's own face keeps the part from -1/2 to ``gap``, the other
    face takes the strip from there to 1/2. Each part counts with the range in its middle: no plane
    is extended beyond its silhouette, where one that is seen edge-on would be anywhere.
    """
    gap, own, other = crossings.gap, crossings.own_face, crossings.other_face
    kept_width, strip_width = 0.5 + gap, 0.5 - gap
    kept = _part(own, 0.5 * (gap - 0.5), crossings, facets, projection, motion)
    strip = _part(other, 0.5 * (gap + 0.5), crossings, facets, projection, motion)
    index = crossings.pixel[:, 1] * projection.width + crossings.pixel[:, 0]
    gained = crossings.sign * ((other >= 0).to(gap) - (own >= 0).to(gap))
    change = kept_width * kept.range + strip_width * strip.range - layer.total.flatten()[index]
    total = _add(layer.total, index, crossings.sign * change)
    area = _add(layer.area, index, strip_width * gained)
    if motion is None:
        return Layer(
            total=total,
            area=area,
            total_derivative=layer.total_derivative,
            area_derivative=layer.area_derivative,
        )
    to_gap = kept.range - strip.range + 0.5 * (kept_width * kept.slope + strip_width * strip.slope)
    gap_derivative = motion.of_bodies(crossings.gap_derivative, crossings.body)
    derivative = (
        kept_width[:, None] * kept.derivative
        + strip_width[:, None] * strip.derivative
        + to_gap[:, None] * gap_derivative
    ).mT - layer.total_derivative.flatten(1)[:, index]
    return Layer(
        total=total,
        area=area,
        total_derivative=_add(layer.total_derivative, index, crossings.sign * derivative),
        area_derivative=_add(layer.area_derivative, index, (-gained[:, None] * gap_derivative).mT),
    )


def _part(
    face: Tensor,
    offset: Tensor,
    crossings: Crossings,
    facets: Facets,
    projection: Projection,
    motion: BodyMotion | None,
) -> _Part:
    """The part whose middle is ``offset`` pixels along ``step`` from the pixel's centre."""
    place = crossings.pixel + offset.detach()[:, None] * crossings.step
    rays = projection.rays(place[:, 0], place[:, 1])
    to_u, to_v = projection.ray_derivatives(place[:, 0], place[:, 1])
    rays_step = to_u * crossings.step[:, :1] + to_v * crossings.step[:, 1:]
    slope = facets.slopes(face, rays, rays_step).detach()
    return _Part(
        range=facets.ranges(face, rays) + slope * (offset - offset.detach()),
        slope=slope,
        derivative=slope if motion is None else motion.of_ranges(facets, face, rays),
    )


def _add(image: Tensor, index: Tensor, values: Tensor) -> Tensor:
    return image.flatten(-2).index_add(-1, index, values).view(image.shape)
