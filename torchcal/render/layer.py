"""Every pixel's own area: filled by what its central ray meets, or by regions of several faces."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.geometry.projection import pixel_grid
from torchcal.model.sensor import Sensor
from torchcal.render.facets import Facets, Spread
from torchcal.render.machine_code import is_traced, machine_code_for
from torchcal.render.motion import BodyMotion
from torchcal.render.soup import Views
from torchcal.render.squares import Squares


@dataclass(frozen=True, kw_only=True, slots=True)
class Layer:
    """Integrals over each pixel's own area, and their derivatives to the parameters."""

    total: Float[Tensor, "view h w"]
    """Of the range (m); the part without a surface counts 0."""
    area: Float[Tensor, "view h w"]
    """Of 1 where there is a surface: pixels."""
    total_derivative: Float[Tensor, "view parameter h w"]
    area_derivative: Float[Tensor, "view parameter h w"] | None
    """None if no silhouette borders on emptiness: all are 0."""
    jump: Bool[Tensor, "view h w"]
    """Whether the range jumps within the pixel."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Sums:
    """Integrals over squares, as in ``Layer``, and their derivatives to the parameters."""

    total: Float[Tensor, " square"]
    area: Float[Tensor, " square"]
    total_derivative: Float[Tensor, "square parameter"]
    area_derivative: Float[Tensor, "square parameter"]

    @staticmethod
    def split(sums: Float[Tensor, "square sum"]) -> "Sums":
        """From the columns total, area, and the derivatives of both."""
        count = (sums.shape[1] - 2) // 2
        total, area, to_total, to_area = sums.split([1, 1, count, count], 1)
        return Sums(
            total=total[:, 0], area=area[:, 0], total_derivative=to_total, area_derivative=to_area
        )


def hard_layer(face: Int[Tensor, "view h w"], views: Views, motion: BodyMotion | None) -> Layer:
    """The layer as if every pixel were filled by the face that its central ray meets.

    On the CPU it is done in machine code where numba is installed, else, and if gradients are to
    be traced, by tensors.

    Args:
        face: Of the triangles of all views; -1 where there is none.
        views: What is seen from where.
        motion: How bodies move with the parameters.
    """
    frames = _pixel_frames(views.sensor, views.vertices)
    module = None if is_traced(views.vertices) else machine_code_for(views.vertices, "layer")
    of_faces = plain_hard_layer if module is None else module.hard_layer
    return of_faces(face, frames, views, motion)


def plain_hard_layer(
    face: Int[Tensor, "view h w"],
    frames: tuple[Tensor, Tensor, Tensor],
    views: Views,
    motion: BodyMotion | None,
) -> Layer:
    """The same by tensor operations, on any device; ``frames`` are the pixels' rays."""
    sensor, (ray, to_u, to_v) = views.sensor, frames
    hits = Facets.of(views.vertices, views.surface.faces).at(face, ray)
    if sensor.beam > 0:
        hits = hits.averaged(Spread.of_square(ray), to_u, to_v)
    hits = hits.between(sensor.near, sensor.far)
    change = hits.range.new_zeros(views.count, 0, *face.shape[1:])
    if motion is not None:
        change = motion.of_images(hits.twist_derivatives(), face)
    return Layer(
        total=hits.range,
        area=(hits.scale != 0).to(hits.range),
        total_derivative=change,
        area_derivative=None,
        jump=torch.zeros_like(face, dtype=torch.bool),
    )


def _pixel_frames(
    sensor: Sensor, like: Tensor
) -> tuple[Float[Tensor, "h w 3"], Float[Tensor, "h w 3"], Float[Tensor, "h w 3"]]:
    """The rays of all pixels and how they turn from column to column and from row to row.

    A pixel's area sees the mean of its rays, an ideal ray the middle.
    """
    projection = sensor.projection
    u, v = pixel_grid(projection, dtype=like.dtype, device=like.device)
    rays, curves = projection.rays(u, v), projection.ray_curvatures(u, v)
    if sensor.beam > 0 and curves is not None:
        rays = rays + (curves[0] + curves[1]) / 24.0
    return rays, *projection.ray_derivatives(u, v)


def with_squares(
    layer: Layer, squares: Squares, sums: Sums, jumps: Bool[Tensor, " square"]
) -> Layer:
    """Puts the integrals of some pixels in the place of those with one face only."""
    place = (squares.view, squares.v, squares.u)
    change, lost = layer.total_derivative, None
    if sums.area_derivative.any():
        lost = _put(torch.zeros_like(change), place, sums.area_derivative)
    return Layer(
        total=layer.total.index_put(place, sums.total.to(layer.total)),
        area=layer.area.index_put(place, sums.area.to(layer.area)),
        total_derivative=_put(change, place, sums.total_derivative),
        area_derivative=lost,
        jump=layer.jump.index_put(place, jumps),
    )


def _put(image: Tensor, place: tuple[Tensor, ...], values: Tensor) -> Tensor:
    """Sets values, each with all parameters, at places (view, v, u)."""
    return image.movedim(1, -1).index_put(place, values.to(image)).movedim(-1, 1)
