"""Range synthesis: what the sensor would measure, and its derivative (eq. 2, 17 and 18).

The hard z-buffer says which face a pixel's centre meets, pixels that silhouettes cross are shared
by area (``sharing.py``), and the beam averages over its box. Range and derivative are closed forms
of the visible faces' planes and edges, so automatic differentiation through the poses works, too.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from torchcal.model.scene import Surface
from torchcal.model.sensor import Sensor
from torchcal.render.beam import beam_area, box_sum
from torchcal.render.layer import Layer, hard_layer
from torchcal.render.mistakes import check_views
from torchcal.render.motion import BodyMotion
from torchcal.render.parts import divided, straight_parts
from torchcal.render.sharing import share_pixels
from torchcal.render.soup import Views, in_soup, soup_of_views
from torchcal.render.visibility import visible_faces

MET = 1e-3
"""Share of the beam that must meet the model before its mean is a prediction."""

AT_ONCE = 1 << 18
"""Pixels and faces, of all views together, that are handled at a time if nobody says otherwise."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Synthesis:
    """Predicted images of a batch of views."""

    range: Float[Tensor, "*batch h w"]
    """m; NaN where the beam meets nothing."""
    coverage: Float[Tensor, "*batch h w"]
    """Share of the beam, inside the image, that meets the model: 0 to 1."""
    face: Int[Tensor, "*batch h w"]
    """The face that the central ray meets; -1 where the model is empty."""
    jump: Bool[Tensor, "*batch h w"]
    """Whether the beam holds a depth jump: real cameras mix or invent ranges there, so those who
    compare with one may leave such pixels out. An ideal ray holds none."""
    jacobian: Float[Tensor, "*batch h w parameter"] | None
    """H of eq. 4: derivative of ``range`` to the parameters of ``motion``; 0 where it is NaN."""


def synthesise(
    surface: Surface,
    Ts_sensor_body: Float[Tensor, "*batch body 4 4"],
    sensor: Sensor,
    motion: Float[Tensor, "*batch body 6 parameter"] | None = None,
    *,
    chunk: int | None = None,
) -> Synthesis:
    """Predicts range images by a soft z-buffer and the beam's box (eq. 17, 18).

    Args:
        surface: The scene's triangles.
        Ts_sensor_body: Pose of every body in the sensor's frame, for each view.
        sensor: Optics, limits and beam.
        motion: How each body moves with the unknown parameters: the twist (m, rad) in the sensor's
            frame, acting on the left of ``Ts_sensor_body``, per unit of each parameter.
        chunk: Views that are handled at a time: it bounds the memory beside the result's own. If
            left out it is chosen by the size of images and scene.

    Returns:
        Images with the batch of the poses; without ``motion`` there is no ``jacobian``.

    Raises:
        TorchcalError: If the mesh, the poses, the motion or the sensor are wrong.
    """
    check_views(surface, Ts_sensor_body, sensor, motion)
    batch = Ts_sensor_body.shape[:-3]
    poses = Ts_sensor_body.reshape(-1, *Ts_sensor_body.shape[-3:])
    parts = straight_parts(sensor)
    fine = divided(sensor, parts)
    chunk = chunk or _views_at_once(surface, fine)
    motions = [None] * len(poses)
    if motion is not None:
        motions = motion.reshape(len(poses), *motion.shape[-3:]).split(chunk)
    views = [
        _every(parts, _synthesise_views(surface, part, fine, moving))
        for part, moving in zip(poses.split(chunk), motions, strict=False)
    ]

    def together(name: str) -> Tensor:
        images = [getattr(view, name) for view in views]
        image = images[0] if len(images) == 1 else torch.cat(images)
        return image.reshape(*batch, *image.shape[1:])

    return Synthesis(
        range=together("range"),
        coverage=together("coverage"),
        face=together("face"),
        jump=together("jump"),
        jacobian=None if motion is None else together("jacobian"),
    )


def place_vertices(
    surface: Surface, Ts_sensor_body: Float[Tensor, "*batch body 4 4"]
) -> Float[Tensor, "*batch vertex 3"]:
    """All vertices (m) in the sensor's frame."""
    T = Ts_sensor_body[..., surface.vertex_body, :, :]
    points = surface.vertices.to(Ts_sensor_body)
    return (T[..., :3, :3] @ points[:, :, None])[..., 0] + T[..., :3, 3]


def _every(parts: int, fine: Synthesis) -> Synthesis:
    """The pixels whose middles those of a sensor's own pixels are."""
    if parts == 1:
        return fine
    own = slice(parts // 2, None, parts)
    return Synthesis(
        range=fine.range[:, own, own],
        coverage=fine.coverage[:, own, own],
        face=fine.face[:, own, own],
        jump=fine.jump[:, own, own],
        jacobian=None if fine.jacobian is None else fine.jacobian[:, own, own],
    )


def _views_at_once(surface: Surface, sensor: Sensor) -> int:
    size = sensor.projection.height * sensor.projection.width + len(surface.faces)
    return max(1, AT_ONCE // size)


def _synthesise_views(
    surface: Surface, Ts_sensor_body: Tensor, sensor: Sensor, motion: Tensor | None
) -> Synthesis:
    projection = sensor.projection
    vertices = place_vertices(surface, Ts_sensor_body)
    face = visible_faces(vertices, surface.faces, projection)
    views = Views(
        sensor=sensor,
        count=len(vertices),
        vertices=vertices.flatten(0, 1),
        surface=soup_of_views(surface, *Ts_sensor_body.shape[:2]),
    )
    soup_face = in_soup(face, len(surface.faces))
    moving = None if motion is None else BodyMotion.of(motion, views.surface)
    layer = hard_layer(soup_face, views, moving)
    # Faces nearer or farther than the sensor measures give no return.
    face = face.masked_fill(layer.area == 0, -1)
    if sensor.beam > 0 and len(face):
        layer = share_pixels(layer, soup_face.masked_fill(face < 0, -1), views, moving)
    synthesis = _average(layer, face, max(sensor.beam, 1))
    return synthesis if motion is not None else replace(synthesis, jacobian=None)


def _average(layer: Layer, face: Tensor, beam: int) -> Synthesis:
    """Eq. 17 and 18: the mean over the part of the box inside the image that has a return."""
    total, area = box_sum(layer.total, beam), box_sum(layer.area, beam)
    height, width = face.shape[1:]
    inside = beam_area(height, width, beam, total)
    met = area > MET * inside
    safe = torch.where(met, area, torch.ones_like(area))
    ranges = total / safe
    share = torch.where(met, safe.reciprocal(), 0.0).detach()[:, None]
    change = box_sum(layer.total_derivative, beam)
    if layer.area_derivative is not None:
        change = change - ranges.detach()[:, None] * box_sum(layer.area_derivative, beam)
    return Synthesis(
        range=torch.where(met, ranges, torch.nan),
        coverage=(area / inside).clamp(0, 1),
        face=face,
        jump=box_sum(layer.jump.to(total), beam) > 0.5,
        jacobian=(share * change).movedim(1, -1),
    )
