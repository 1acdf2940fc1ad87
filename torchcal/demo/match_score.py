"""Which matches of elements are right, judged from the true pose with the ray caster.

No covariance has a say in it: a plane is judged by what its part of the image truly shows, a line
by where the image truly shows its partner.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import ConvexHull
from torch import Tensor

from torchcal.demo import raycast
from torchcal.geometry import se3
from torchcal.geometry.projection import Projection, pixel_grid
from torchcal.match.features import Features, Planes

STEP = 4
"""Pixels between the rays that planes are judged by."""
NEAR = 0.05
"""m: what is farther from a measured plane is something else before or behind it."""
SAME = 0.01
"""m and rad: what is nearer to a plane of the model is on it."""
MOST = 0.5
"""Share of a measured plane's part of the image that must show its partner."""
PIXELS = 5.0
"""Most between both ends of a measured line, or a measured vertex, and its partner."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Truth:
    """What an image truly shows, and where."""

    T_sensor_world: Float[Tensor, "4 4"]
    projection: Projection
    pixels: Float[ndarray, "ray 2"]
    points: Float[ndarray, "ray 3"]
    """m, in the sensor's frame"""
    normals: Float[ndarray, "ray 3"]

    @staticmethod
    def of(
        meshes: Sequence[trimesh.Trimesh],
        T_world_sensor: Float[Tensor, "4 4"],
        projection: Projection,
    ) -> "Truth":
        """Casts rays.

        Args:
            meshes: What there is to be seen (m, world frame).
            T_world_sensor: The true pose.
            projection: The sensor's optics.
        """
        scene = raycast.view(meshes, T_world_sensor.numpy())
        grid = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
        u, v = (each[::STEP, ::STEP].flatten() for each in grid)
        rays = projection.rays(u, v).numpy()
        ranges, face = raycast.cast(scene, rays)
        met = face >= 0
        normals = scene.normals[face[met]]
        return Truth(
            T_sensor_world=se3.inverse(T_world_sensor),
            projection=projection,
            pixels=torch.stack([u, v], -1).numpy()[met],
            points=ranges[met, None] * rays[met],
            normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        )


def right_matches(
    model: Features, measured: Features, pairs: Int[Tensor, "pair 2"], truth: Truth
) -> Bool[ndarray, " pair"]:
    """Whether the elements of each pair are one.

    Args:
        model: In the world's frame; planes count first, then lines, then vertexes.
        measured: In the sensor's frame, in the same order.
        pairs: Of the model, and measured.
        truth: What the image shows.
    """
    sides = [
        [
            (kind, row)
            for kind, part in enumerate((side.planes, side.lines, side.vertices))
            for row in range(part.elements.count)
        ]
        for side in (model, measured)
    ]
    right = []
    for own, other in pairs.tolist():
        (kind, row), (_, column) = sides[0][own], sides[1][other]
        if kind == 0:
            right.append(_is_plane(model.planes, row, measured.planes, column, truth))
        elif kind == 1:
            ends = measured.lines.ends[column]
            right.append(_is_line(model.lines.ends[row], ends, truth))
        else:
            places = model.vertices.elements.point[row], measured.vertices.elements.point[column]
            right.append(_is_vertex(*places, truth))
    return np.array(right, bool)


def _is_plane(model: Planes, row: int, measured: Planes, column: int, truth: Truth) -> bool:
    """Whether most of what the measured plane covers in the image is on the model's."""
    corners = truth.projection.pixels(measured.outline[column]).numpy()
    sides = ConvexHull(corners).equations
    own, other = model.elements, measured.elements
    near = np.abs((truth.points - other.point[column].numpy()) @ other.direction[column].numpy())
    shown = (truth.pixels @ sides[:, :2].T + sides[:, 2] <= 0.0).all(1) & (near < NEAR)
    T = truth.T_sensor_world
    point, normal = (
        se3.transform(T, own.point[row, None])[0].numpy(),
        (T[:3, :3] @ own.direction[row]).numpy(),
    )
    off = np.abs((truth.points[shown] - point) @ normal)
    turned = np.linalg.norm(np.cross(truth.normals[shown], normal), axis=1)
    return bool(((off < SAME) & (turned < SAME)).sum() > MOST * max(1, shown.sum()))


def _is_line(own: Tensor, measured: Tensor, truth: Truth) -> bool:
    """Whether both ends of the measured line are beside the model's, in the image."""
    a, b = truth.projection.pixels(se3.transform(truth.T_sensor_world, own)).numpy()
    ends = truth.projection.pixels(measured).numpy()
    length = np.linalg.norm(b - a)
    along = (b - a) / length
    across = np.abs((ends - a) @ np.array([-along[1], along[0]]))
    place = (ends - a) @ along
    shared = min(place.max(), length) - max(place.min(), 0.0)
    return bool(across.max() < PIXELS and shared > 0.5 * np.ptp(place))


def _is_vertex(own: Tensor, measured: Tensor, truth: Truth) -> bool:
    places = torch.stack([se3.transform(truth.T_sensor_world, own[None])[0], measured])
    one, two = truth.projection.pixels(places)
    return float((one - two).norm()) < PIXELS
