"""What a pixel shows of the model: whose surface, in which colour, turned which way."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from torchcal.geometry.projection import Projection, pixel_grid
from torchcal.model.paint import Paint
from torchcal.model.scene import Scene
from torchcal.model.sensor import Sensor
from torchcal.render.facets import Facets, dot
from torchcal.render.synthesis import place_vertices

AT_ONCE = 1 << 18
"""Pixels that are painted at a time."""

SMALLEST = 1e-30
"""Twice the area (m^2), squared, of a face that is seen edge-on or has none."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Appearance:
    """Of the surface that the central ray of each pixel meets; 0 where there is none."""

    colour: Float[Tensor, "h w 3"]
    """The model's own, unshaded, 0 to 1."""
    normal: Float[Tensor, "h w 3"]
    """Unit, towards the sensor, in its frame."""
    body: Int[Tensor, "h w"]
    """Index into ``Scene.bodies``; -1 where the model is empty."""


@dataclass(frozen=True, kw_only=True, slots=True)
class _Seen:
    """Some pixels and the faces that they show."""

    u: Float[Tensor, " pixel"]
    v: Float[Tensor, " pixel"]
    face: Int[Tensor, " pixel"]
    corners: Float[Tensor, "pixel 3 3"]
    """m, in the sensor's frame."""


def appearance(
    scene: Scene,
    Ts_sensor_body: Float[Tensor, "body 4 4"],
    sensor: Sensor,
    face: Int[Tensor, "h w"],
) -> Appearance:
    """What an image of the scene shows.

    Args:
        scene: What the sensor looks at.
        Ts_sensor_body: Where its bodies stand.
        sensor: Its optics.
        face: What the central ray of every pixel meets, as ``synthesise`` says it; -1 for nothing.
    """
    surface = scene.surface
    vertices = place_vertices(surface, Ts_sensor_body)
    u, v = pixel_grid(sensor.projection, dtype=vertices.dtype, device=vertices.device)
    normal = Facets.of(vertices, surface.faces).normal[face]  # the last one is no face's
    normal = torch.nn.functional.normalize(normal, dim=-1)
    away = dot(normal, sensor.projection.rays(u, v)) > 0
    colour = torch.zeros_like(normal)
    for some in (face >= 0).flatten().nonzero()[:, 0].split(AT_ONCE):
        index = face.flatten()[some]
        corners = vertices[surface.faces[index]]
        seen = _Seen(u=u.flatten()[some], v=v.flatten()[some], face=index, corners=corners)
        colour.view(-1, 3)[some] = _painted(scene.paint, seen, sensor.projection).to(colour)
    return Appearance(
        colour=colour,
        normal=torch.where(away[..., None], -normal, normal),
        body=surface.vertex_body[surface.faces[face, 0]].masked_fill(face < 0, -1),
    )


def _painted(paint: Paint, seen: _Seen, lens: Projection) -> Float[Tensor, "pixel 3"]:
    """The colour of every pixel's middle, an image's averaged over the pixel."""
    weights = _weights(seen, lens.rays(seen.u, seen.v))
    colour = (weights[..., None] * paint.colour[seen.face].to(weights)).sum(1).clamp(0.0, 1.0)
    for index, image in enumerate(paint.images):
        on = (paint.image[seen.face] == index).nonzero()[:, 0]
        if len(on):
            here = _Seen(u=seen.u[on], v=seen.v[on], face=seen.face[on], corners=seen.corners[on])
            colour[on] *= _texture(image, paint.uv[here.face].to(colour), here, lens)
    return colour


def _weights(seen: _Seen, rays: Float[Tensor, "pixel 3"]) -> Float[Tensor, "pixel 3"]:
    """Barycentric coordinates of the points in which rays meet the planes of faces."""
    a, b, c = seen.corners.unbind(1)
    normal = torch.linalg.cross(b - a, c - a)
    point = rays * (dot(normal, a) / dot(normal, rays))[:, None]
    opposite = ((b, c), (c, a), (a, b))
    areas = [dot(normal, torch.linalg.cross(q - p, point - p)) for p, q in opposite]
    return torch.stack(areas, -1) / dot(normal, normal).clamp(min=SMALLEST)[:, None]


def _texture(
    image: UInt8[Tensor, "_ _ 3"], uv: Float[Tensor, "pixel 3 2"], seen: _Seen, lens: Projection
) -> Float[Tensor, "pixel 3"]:
    """An image's colours (0 to 1), from a copy as coarse as the pixels, so that nothing aliases."""
    size = uv.new_tensor([image.shape[1], image.shape[0]])

    def at(u: Tensor, v: Tensor) -> Tensor:
        return (_weights(seen, lens.rays(u, v))[..., None] * uv).sum(1)

    middle = at(seen.u, seen.v)
    steps = torch.stack([at(seen.u + 1.0, seen.v), at(seen.u, seen.v + 1.0)]) - middle
    texels = (steps * size).norm(dim=-1).amax(0).nan_to_num(nan=1.0).clamp(min=1.0)
    level = texels.log2().round().long()
    colour = torch.zeros_like(seen.corners[:, 0])
    coarse = image.movedim(-1, 0)[None].to(colour) / 255.0
    for step in range(int(level.max()) + 1):
        on = level == step if min(coarse.shape[-2:]) > 1 else level >= step
        colour[on] = _bilinear(coarse[0].movedim(0, -1), middle[on])
        if min(coarse.shape[-2:]) == 1:
            break
        coarse = torch.nn.functional.avg_pool2d(coarse, 2)
    return colour


def _bilinear(
    image: Float[Tensor, "rows columns 3"], uv: Float[Tensor, "pixel 2"]
) -> Float[Tensor, "pixel 3"]:
    """Between the middles of texels; the image repeats."""
    rows, columns = image.shape[:2]
    x, y = uv[:, 0] * columns - 0.5, (1.0 - uv[:, 1]) * rows - 0.5
    left, top = x.floor(), y.floor()
    right, low = (x - left)[:, None], (y - top)[:, None]
    columns_at = [(left.long() + step) % columns for step in (0, 1)]
    rows_at = [(top.long() + step) % rows for step in (0, 1)]
    (a, b), (c, d) = ([image[row, column] for column in columns_at] for row in rows_at)
    return (1 - low) * ((1 - right) * a + right * b) + low * ((1 - right) * c + right * d)
