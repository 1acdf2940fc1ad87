"""Range synthesis: what the sensor would measure, and its derivative (eq. 2, 17 and 18).

The hard z-buffer says which face a pixel's centre meets, silhouettes shift the share of a pixel from
one surface to the other, and the beam averages over its box. Range and derivative are closed forms
of the visible faces' planes and edges, so automatic differentiation through the poses works as well.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection, pixel_grid
from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor
from torchcal.render.beam import beam_area, box_sum
from torchcal.render.crossings import Crossings, find_crossings
from torchcal.render.facets import Facets
from torchcal.render.visibility import visible_faces


MET = 1e-3
"""Share of the beam that must meet the model before its mean is a prediction."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Synthesis:
    """Predicted images of a batch of views."""

    range: Float[Tensor, "*batch h w"]
    """m; NaN where the beam meets nothing."""
    coverage: Float[Tensor, "*batch h w"]
    """Share of the beam, inside the image, that meets the model: 0 to 1."""
    face: Int[Tensor, "*batch h w"]
    """The face that the central ray meets; -1 where the model is empty."""
    jacobian: Float[Tensor, "*batch h w parameter"] | None
    """H of eq. 4: derivative of ``range`` to the parameters of ``motion``; 0 where there is none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Layer:
    """Sums over one pixel's own area: range times area, area, and their derivatives."""

    total: Float[Tensor, "h w"]
    area: Float[Tensor, "h w"]
    total_derivative: Float[Tensor, "parameter h w"]
    area_derivative: Float[Tensor, "parameter h w"]


def synthesise(
    surface: Surface,
    Ts_sensor_body: Float[Tensor, "*batch body 4 4"],
    sensor: Sensor,
    motion: Float[Tensor, "*batch body 6 parameter"] | None = None,
) -> Synthesis:
    """Predicts range images by a soft z-buffer and the beam's box (eq. 17, 18).

    Args:
        surface: The scene's triangles.
        Ts_sensor_body: Pose of every body in the sensor's frame, for each view.
        sensor: Optics, limits and beam.
        motion: How each body moves with the unknown parameters: the twist (m, rad) in the sensor's
            frame, acting on the left of ``Ts_sensor_body``, per unit of each parameter.

    Returns:
        Images with the batch of the poses; without ``motion`` there is no ``jacobian``.
    """
    batch = Ts_sensor_body.shape[:-3]
    poses = Ts_sensor_body.reshape(-1, *Ts_sensor_body.shape[-3:])
    motions = None if motion is None else motion.reshape(-1, *motion.shape[-3:])
    views = [
        _synthesise_view(surface, T, sensor, None if motions is None else motions[i])
        for i, T in enumerate(poses)
    ]

    def stacked(name: str) -> Tensor:
        images = torch.stack([getattr(view, name) for view in views])
        return images.reshape(*batch, *images.shape[1:])

    return Synthesis(
        range=stacked("range"),
        coverage=stacked("coverage"),
        face=stacked("face"),
        jacobian=None if motion is None else stacked("jacobian"),
    )


def place_vertices(
    surface: Surface, Ts_sensor_body: Float[Tensor, "*batch body 4 4"]
) -> Float[Tensor, "*batch vertex 3"]:
    """All vertices (m) in the sensor's frame."""
    T = Ts_sensor_body[..., surface.vertex_body, :, :]
    points = surface.vertices.to(Ts_sensor_body)
    return (T[..., :3, :3] @ points[:, :, None])[..., 0] + T[..., :3, 3]


def _synthesise_view(
    surface: Surface, Ts_sensor_body: Tensor, sensor: Sensor, motion: Tensor | None
) -> Synthesis:
    vertices = place_vertices(surface, Ts_sensor_body)
    facets = Facets.of(vertices, surface.faces)
    face = visible_faces(vertices.detach()[None], surface.faces, sensor.projection)[0]
    rays = _grid_rays(sensor.projection, vertices)
    face = _within_limits(face, facets, rays, sensor)
    layer = _hard_layer(face, facets, rays, surface, motion)
    if sensor.beam > 0:
        crossings = find_crossings(vertices, surface, facets, face, sensor.projection)
        layer = _soften(layer, crossings, facets, surface, sensor.projection, motion)
    return _average(layer, face, max(sensor.beam, 1), motion is not None)


def _grid_rays(projection: Projection, like: Tensor) -> Tensor:
    return projection.rays(*pixel_grid(projection, dtype=like.dtype, device=like.device))


def _within_limits(face: Tensor, facets: Facets, rays: Tensor, sensor: Sensor) -> Tensor:
    """Faces nearer or farther than the sensor measures give no return."""
    ranges = facets.ranges(face, rays).detach()
    return torch.where((ranges >= sensor.near) & (ranges <= sensor.far), face, -1)


def _hard_layer(
    face: Tensor, facets: Facets, rays: Tensor, surface: Surface, motion: Tensor | None
) -> _Layer:
    """The pixels' own areas as if each were filled by what its central ray meets."""
    total = facets.ranges(face, rays)
    derivative = _along_motion(facets.twist_derivatives(face, rays), face, surface, motion)
    derivative = derivative.movedim(-1, 0)
    return _Layer(
        total=total,
        area=(face >= 0).to(total),
        total_derivative=derivative,
        area_derivative=torch.zeros_like(derivative),
    )


def _along_motion(
    twist_derivative: Tensor, face: Tensor, surface: Surface, motion: Tensor | None
) -> Tensor:
    """Chain rule from the twist of the face's body to the parameters."""
    body = surface.vertex_body[surface.faces[face.clamp(min=0), 0]]
    return _chain(twist_derivative, body, motion)


def _chain(twist_derivative: Tensor, body: Tensor, motion: Tensor | None) -> Tensor:
    """Applies to each row the motion of its body; bodies that move alike are taken together."""
    if motion is None:
        return twist_derivative[..., :0]
    kinds, kind = torch.unique(motion, dim=0, return_inverse=True)
    result = twist_derivative @ kinds[0]
    for i in range(1, len(kinds)):
        chosen = (kind[body] == i)[..., None]
        result = torch.where(chosen, twist_derivative @ kinds[i], result)
    return result


def _soften(
    layer: _Layer,
    crossings: Crossings,
    facets: Facets,
    surface: Surface,
    projection: Projection,
    motion: Tensor | None,
) -> _Layer:
    """Gives the strips beyond the silhouettes to the surfaces that are seen there.

    In the row of a crossing the pixel's own face keeps the part from -1/2 to ``gap``, the other face
    takes the strip from there to 1/2. Each part counts with the range in its middle: no plane is
    extended to where it is not seen, so near-horizontal ones stay finite.
    """
    gap, gap_detached = crossings.gap, crossings.gap.detach()
    kept_width, strip_width = 0.5 + gap, 0.5 - gap
    kept = _middle(crossings.own_face, crossings, 0.5 * (gap - 0.5), facets, projection)
    strip = _middle(crossings.other_face, crossings, 0.5 * (gap + 0.5), facets, projection)
    index = crossings.pixel[:, 1] * projection.width + crossings.pixel[:, 0]
    gained = (crossings.other_face >= 0).to(gap) - (crossings.own_face >= 0).to(gap)
    total = kept_width * kept.range + strip_width * strip.range - layer.total.flatten()[index]
    gap_derivative = _chain(crossings.gap_derivative, crossings.body, motion)
    to_gap = kept.range - strip.range + 0.5 * (kept_width * kept.slope + strip_width * strip.slope)
    total_derivative = (
        kept_width[:, None] * _along_motion(kept.derivative, crossings.own_face, surface, motion)
        + strip_width[:, None] * _along_motion(strip.derivative, crossings.other_face, surface, motion)
        + to_gap[:, None] * gap_derivative
    ).mT - layer.total_derivative.flatten(1)[:, index]
    return _Layer(
        total=_add(layer.total, index, total),
        area=_add(layer.area, index, strip_width * gained),
        total_derivative=_add(layer.total_derivative, index, total_derivative),
        area_derivative=_add(layer.area_derivative, index, (-gained[:, None] * gap_derivative).mT),
    )


@dataclass(frozen=True, kw_only=True, slots=True)
class _Middle:
    range: Tensor
    slope: Tensor
    derivative: Tensor


def _middle(face, crossings, offset, facets, projection):
    place = crossings.pixel + offset.detach()[:, None] * crossings.step
    u, v = place.unbind(-1)
    rays = projection.rays(u, v)
    to_u, to_v = projection.ray_derivatives(u, v)
    slope = facets.slopes(face, rays, to_u * crossings.step[:, :1] + to_v * crossings.step[:, 1:]).detach()
    return _Middle(range=facets.ranges(face, rays) + slope * (offset - offset.detach()), slope=slope, derivative=facets.twist_derivatives(face, rays))


def _add(image: Tensor, index: Tensor, values: Tensor) -> Tensor:
    return image.flatten(-2).index_add(-1, index, values).view(image.shape)


def _average(layer: _Layer, face: Tensor, beam: int, with_jacobian: bool) -> Synthesis:
    """Eq. 17 and 18: the mean over the part of the box that is inside the image and has a return."""
    total, area = (box_sum(x, beam) for x in (layer.total, layer.area))
    inside = beam_area(*face.shape, beam, total)
    met = area > MET * inside
    safe = torch.where(met, area, torch.ones_like(area))
    ranges = total / safe
    jacobian = None
    if with_jacobian:
        change = box_sum(layer.total_derivative, beam)
        change = change - ranges.detach() * box_sum(layer.area_derivative, beam)
        jacobian = torch.where(met, change / safe, torch.zeros_like(change)).movedim(0, -1)
    return Synthesis(
        range=torch.where(met, ranges, torch.nan),
        coverage=(area / inside).clamp(0, 1),
        face=face,
        jacobian=jacobian,
    )
