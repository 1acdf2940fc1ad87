"""Which elements of model and image are in one place, seen from a pose.

A jump edge is sure across the line of sight and hardly along it: lines are compared in the image.
"""

import math

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.projection import Projection
from torchcal.match.features import Features

ANGLE = math.radians(2.0)
"""Most between directions: of lines in the image, of planes in space (rad)."""
PIXELS = 5.0
"""Most between a measured line and the model's, at both ends of the measured one."""
DISTANCE = 0.05
"""m: most between planes, at the point of the measured one."""
NEAR = 0.1
"""m: most between vertexes."""


def in_one_place(
    model: Features,
    measured: Features,
    T_world_sensor: Float[Tensor, "4 4"],
    projection: Projection,
) -> Bool[Tensor, "model measured"]:
    """Pairs of elements that lie on each other; planes first, then lines, then vertexes.

    Args:
        model: In the world's frame.
        measured: In the sensor's frame.
        T_world_sensor: The pose to look from.
        projection: The sensor's optics.
    """
    T = se3.inverse(T_world_sensor)
    blocks = (
        _same_planes(model, measured, T),
        _same_lines(model, measured, T, projection),
        _same_vertices(model, measured, T),
    )
    return torch.block_diag(*(block.double() for block in blocks)) > 0


def _same_planes(model: Features, measured: Features, T: Tensor) -> Tensor:
    own, other = model.planes.elements, measured.planes.elements
    normal = own.direction @ T[:3, :3].mT
    offset = (normal * se3.transform(T, own.point)).sum(-1, keepdim=True)
    along = normal @ other.direction.mT > math.cos(ANGLE)
    return along & ((normal @ other.point.mT - offset).abs() < DISTANCE)


def _same_lines(model: Features, measured: Features, T: Tensor, projection: Projection) -> Tensor:
    """In the image: both ends of the measured line are on the model's, which is not clipped."""
    own, other = model.lines.elements, measured.lines.ends
    point, along = se3.transform(T, own.point)[:, None], own.direction @ T[:3, :3].mT
    middle = other.mean(1)
    # The model's line through the two planes across the measured one's ends.
    direction = torch.nn.functional.normalize(other[:, 1] - other[:, 0], dim=-1)
    slope = along @ direction.mT
    steps = (direction * (middle - point)).sum(-1) / slope
    half = 0.5 * (other[:, 1] - other[:, 0]).norm(dim=-1) / slope
    ends = torch.stack([steps - half, steps + half], -1)
    places = point[:, :, None] + ends[..., None] * along[:, None, None]
    seen = (places[..., 2] > 0.0).all(-1) & (slope.abs() > math.cos(math.radians(15.0)))
    off = (projection.pixels(places) - projection.pixels(other)).norm(dim=-1).amax(-1)
    return seen & (off < PIXELS)


def _same_vertices(model: Features, measured: Features, T: Tensor) -> Tensor:
    own = se3.transform(T, model.vertices.elements.point)
    return torch.cdist(own, measured.vertices.elements.point) < NEAR
