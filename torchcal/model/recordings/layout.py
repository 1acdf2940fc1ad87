"""Clouds and scans as images of a spherical sensor or a pinhole.

ROS's sensors look along x with z up, torchcal's along z with y down: the sensor of a job stands in
the frame of its cloud with one of two orientations, ``OPTICAL`` or ``BODY``.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole, Spherical
from torchcal.model.meshes import FARTHEST

Points = NDArray[np.float64]

OPTICAL = np.eye(3)
"""R_cloud_sensor of a cloud with x right, y down, z forward."""
BODY = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""R_cloud_sensor of a cloud with x forward, y left, z up."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Layout:
    """How points become an image."""

    projection: Pinhole | Spherical
    R_cloud_sensor: Points
    flipped: tuple[int, ...] = ()
    """The axes along which an organised cloud runs the other way."""

    @property
    def T_cloud_sensor(self) -> Float[Tensor, "4 4"]:
        """Where the sensor stands in the frame of the cloud."""
        R = torch.from_numpy(self.R_cloud_sensor.copy())
        return se3.from_rotation_translation(R, torch.zeros(3, dtype=torch.float64))

    def organised(self, points: Points) -> NDArray[np.float32]:
        """The image of points ``(h w 3)`` that stand where their pixels are; NaN: not measured."""
        seen = torch.from_numpy(points @ self.R_cloud_sensor)
        return np.flip(self.projection.ranges(seen).numpy(), self.flipped).astype(np.float32)


def measured(points: Points) -> NDArray[np.bool_]:
    """Which points ``(*batch 3)`` were measured: some sensors send 0 or NaN for the others."""
    return np.logical_and(np.isfinite(points).all(-1), points.any(-1))


def sound(points: Points) -> Points:
    """Points ``(*batch 3)`` (m) with NaN for those that are infinitely or absurdly far away."""
    return np.where((np.abs(points) < FARTHEST).all(-1, keepdims=True), points, np.nan)


def angles(points: Points) -> tuple[Points, Points]:
    """Azimuth and elevation (rad) of points in the sensor's axes."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.arctan2(x, z), np.arctan2(-y, np.hypot(x, z))


def centred(first: float, last: float) -> tuple[float, float]:
    """The same angles (rad) with their middle within half a turn."""
    turn = 2.0 * math.pi * round((first + last) / (4.0 * math.pi))
    return first - turn, last - turn
