"""Clouds as the images of one sensor."""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchcal.geometry.projection import Pinhole
from torchcal.model.recordings.kinds import CAMERA_NOISE, LASER_NOISE
from torchcal.model.recordings.layout import Layout, Points
from torchcal.model.recordings.organised import organised_layout
from torchcal.model.recordings.recorded import Optics
from torchcal.model.recordings.unorganised import (
    own_resolution,
    projected_image,
    projected_layout,
)


@dataclass(frozen=True, kw_only=True, slots=True)
class CloudImages:
    """How the clouds of one sensor become images."""

    layout: Layout
    in_order: bool
    """Whether each point stands in the place of its pixel."""
    note: str
    """The same for a person."""

    @property
    def optics(self) -> Optics:
        """The sensor: a camera, or one whose beams are thin."""
        hole = self.layout.projection
        camera = isinstance(hole, Pinhole)
        sigma = CAMERA_NOISE if camera else LASER_NOISE
        return Optics(projection=hole, sigma=sigma, beam=1 if camera else 0)

    def image(self, points: Points) -> NDArray[np.float32]:
        """The image (m) of a cloud ``(h w 3)``; NaN: not measured."""
        if self.in_order:
            return self.layout.organised(points)
        return projected_image(points.reshape(-1, 3), self.layout)


def cloud_images(
    clouds: Callable[[], Iterable[Points]], resolution_deg: float | None
) -> CloudImages:
    """How the clouds of one sensor become images.

    Organised clouds of a pinhole or a spherical sensor stay as they are, others are projected onto
    a spherical sensor that sees all of them.

    Args:
        clouds: Gives the clouds ``(h w 3)`` (m), in the sensor's own frame, again and again.
        resolution_deg: Of the projection; None: 1.5 times the angle between neighbouring points.

    Raises:
        ValueError: If there are no points, or the resolution makes too large an image.
    """
    first = next(iter(clouds()))
    layout = organised_layout(first) if resolution_deg is None else None
    if layout is not None and all(points.shape == first.shape for points in clouds()):
        kind = type(layout.projection).__name__.lower()
        note = f"organised clouds were taken as they are: a {kind} image"
        return CloudImages(layout=layout, in_order=True, note=note)
    flat = (points.reshape(-1, 3) for points in clouds())
    if resolution_deg is None:
        step = own_resolution(first.reshape(-1, 3))
    else:
        step = math.radians(resolution_deg)
    layout = projected_layout(flat, step)
    size = f"{layout.projection.width}x{layout.projection.height}"
    note = (
        f"points were projected onto {size} pixels of {math.degrees(step):.3g} degrees: "
        "--resolution says otherwise"
    )
    return CloudImages(layout=layout, in_order=False, note=note)
