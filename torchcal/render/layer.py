"""Every pixel's own area: filled by what its central ray meets, or by regions of several faces."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.render.facets import Hits, dot
from torchcal.render.motion import BodyMotion
from torchcal.render.regions import Regions, Rims
from torchcal.render.squares import Squares


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


@dataclass(frozen=True, kw_only=True, slots=True)
class BorderPlanes:
    """The planes through the sensor that hold the borders."""

    normal: Float[Tensor, "border 3"]
    """first x last: not normalised."""
    along: Float[Tensor, "border 3"]
    """From the first end to the last one (m)."""
    body: Int[Tensor, " border"]

    def values(self, rims: Rims, lever: Float[Tensor, "rim 3"]) -> Float[Tensor, " rim"]:
        """Normal . lever: 0, but its derivative is not."""
        return dot(self.normal[rims.border], lever)

    def twist_derivatives(
        self, rims: Rims, lever: Float[Tensor, "rim 3"]
    ) -> Float[Tensor, "rim 6"]:
        """Derivative of ``values`` to the motion of the border, a twist in the sensor's frame."""
        along, normal = self.along[rims.border], self.normal[rims.border]
        return torch.cat([torch.linalg.cross(along, lever), torch.linalg.cross(normal, lever)], -1)


def hard_layer(face: Int[Tensor, "view h w"], hits: Hits, motion: BodyMotion | None) -> Layer:
    """The layer as if every pixel were filled by the face that its central ray meets."""
    views, height, width = face.shape
    derivative = hits.range.new_zeros(views, 0, height, width)
    if motion is not None:
        derivative = motion.of_images(hits.twist_derivatives(), face)
    area = (face >= 0).to(hits.range)
    return Layer(total=hits.range, area=area, total_derivative=derivative)


def with_regions(
    layer: Layer,
    squares: Squares,
    regions: Regions,
    hits: Hits,
    rims: Rims,
    planes: BorderPlanes,
    motion: BodyMotion | None,
) -> Layer:
    """Fills the squares by regions and lets these move with their rims.

    Args:
        layer: The layer in which every pixel shows one face.
        squares: The pixels to fill.
        regions: What they show.
        hits: The mean ranges of the regions.
        rims: Where regions end.
        planes: Of the borders.
        motion: How bodies move with the parameters.
    """
    filled = regions.area.to(hits.range)
    met = (hits.scale != 0).to(hits.range) * filled

    def summed(of_regions: Tensor, of_rims: Tensor) -> Tensor:
        zeros = of_regions.new_zeros(len(squares.view), *of_regions.shape[1:])
        of_rims = of_rims.to(zeros)
        return zeros.index_add(0, regions.square, of_regions).index_add(0, rims.square, of_rims)

    place = (squares.view, squares.v, squares.u)
    total = summed(hits.range * filled, planes.values(rims, rims.total_lever))
    area = summed(met, planes.values(rims, rims.area_lever))
    total = layer.total.index_put(place, total.to(layer.total))
    area = layer.area.index_put(place, area.to(layer.area))
    if motion is None:
        return Layer(total=total, area=area, total_derivative=layer.total_derivative)
    view = squares.view[rims.square]

    def of_rims(lever: Tensor) -> Tensor:
        twists = planes.twist_derivatives(rims, lever).to(hits.range)
        return motion.of_bodies(twists, planes.body[rims.border], view)

    twists = hits.twist_derivatives().mT * filled[:, None]
    inner = motion.of_faces(twists, regions.face, squares.view[regions.square])
    change = _put(layer.total_derivative, place, summed(inner, of_rims(rims.total_lever)))
    if not rims.area_lever.any():
        return Layer(total=total, area=area, total_derivative=change)
    lost = summed(torch.zeros_like(inner), of_rims(rims.area_lever))
    lost = _put(torch.zeros_like(layer.total_derivative), place, lost)
    return Layer(total=total, area=area, total_derivative=change, area_derivative=lost)


def _put(image: Tensor, place: tuple[Tensor, ...], values: Tensor) -> Tensor:
    """Sets values, each with all parameters, at places (view, v, u)."""
    return image.movedim(1, -1).index_put(place, values.to(image)).movedim(-1, 1)
