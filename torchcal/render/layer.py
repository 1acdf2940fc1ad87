"""Every pixel's own area: filled by what its central ray meets, then shared along silhouettes."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection
from torchcal.render.crossings import Crossings
from torchcal.render.facets import Facets, Hits
from torchcal.render.motion import BodyMotion


@dataclass(frozen=True, kw_only=True, slots=True)
class Layer:
    """Integrals over each pixel's own area, and their derivatives to the parameters."""

    total: Float[Tensor, "view h w"]
    """Of the range (m); the part without a surface counts 0."""
    area: Float[Tensor, "view h w"]
    """Of 1 where there is a surface: pixels."""
    total_derivative: Float[Tensor, "view parameter h w"]
    area_derivative: Float[Tensor, "view parameter h w"] | None = None
    """None if no silhouette borders on emptiness: all are 0."""

    def crop(self, rows: slice, columns: slice) -> "Layer":
        """The part in some rows and columns."""
        change = self.area_derivative
        return Layer(
            total=self.total[..., rows, columns],
            area=self.area[..., rows, columns],
            total_derivative=self.total_derivative[..., rows, columns],
            area_derivative=None if change is None else change[..., rows, columns],
        )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Part:
    """A part of each crossing's pixel, by the range in its middle."""

    range: Tensor
    slope: Tensor
    """Derivative of the range to the middle's place."""
    derivative: Tensor
    """Derivative of the range to the parameters, the middle at rest."""


def hard_layer(face: Int[Tensor, "view h w"], hits: Hits, motion: BodyMotion | None) -> Layer:
    """The layer as if every pixel were filled by the face that its central ray meets."""
    views, height, width = face.shape
    derivative = hits.range.new_zeros(views, 0, height, width)
    if motion is not None:
        derivative = motion.of_images(hits.twist_derivatives(), face)
    area = (face >= 0).to(hits.range)
    return Layer(total=hits.range, area=area, total_derivative=derivative)


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
    view, (u, v) = crossings.view, crossings.pixel.unbind(1)
    place = (view, v, u)
    gained = crossings.sign * ((other >= 0).to(gap) - (own >= 0).to(gap))
    change = kept_width * kept.range + strip_width * strip.range - layer.total[place]
    total = _add(layer.total, place, crossings.sign * change)
    area = _add(layer.area, place, strip_width * gained)
    if motion is None:
        return Layer(total=total, area=area, total_derivative=layer.total_derivative)
    to_gap = kept.range - strip.range + 0.5 * (kept_width * kept.slope + strip_width * strip.slope)
    gap_derivative = motion.of_bodies(crossings.gap_derivative, crossings.body, view)
    derivative = (
        kept_width[:, None] * kept.derivative
        + strip_width[:, None] * strip.derivative
        + to_gap[:, None] * gap_derivative
        - layer.total_derivative.movedim(1, -1)[place]
    )
    change = _add(layer.total_derivative, place, crossings.sign[:, None] * derivative)
    if not gained.any():
        return Layer(total=total, area=area, total_derivative=change)
    lost = _add(torch.zeros_like(change), place, -gained[:, None] * gap_derivative)
    return Layer(total=total, area=area, total_derivative=change, area_derivative=lost)


def _part(
    face: Tensor,
    offset: Tensor,
    crossings: Crossings,
    facets: Facets,
    projection: Projection,
    motion: BodyMotion | None,
) -> _Part:
    """The part whose middle is ``offset`` pixels along ``step`` from the pixel's centre."""
    u, v = (crossings.pixel + offset.detach()[:, None] * crossings.step).unbind(1)
    hits = facets.at(face, projection.rays(u, v))
    to_u, to_v = projection.ray_derivatives(u, v)
    slope = hits.slopes(to_u * crossings.step[:, :1] + to_v * crossings.step[:, 1:]).detach()
    derivative = slope
    if motion is not None:
        derivative = motion.of_faces(hits.twist_derivatives().mT, face, crossings.view)
    return _Part(
        range=hits.range + slope * (offset - offset.detach()), slope=slope, derivative=derivative
    )


def _add(image: Tensor, place: tuple[Tensor, ...], values: Tensor) -> Tensor:
    """Adds values, each with all parameters where the image has them, at places (view, v, u)."""
    if image.ndim == 3:
        return image.index_put(place, values, accumulate=True)
    return image.movedim(1, -1).index_put(place, values, accumulate=True).movedim(-1, 1)
