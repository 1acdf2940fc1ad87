"""``LaserScan`` messages: spherical sensors of one row."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchcal.geometry.projection import Spherical
from torchcal.model.recordings.layout import BODY, Layout, centred


def scan_layout(message: Any) -> Layout:
    """The layout of a ``LaserScan``: one row, in which azimuth grows to the right.

    Raises:
        ValueError: If it has no angles.
    """
    count, step = len(message.ranges), float(message.angle_increment)
    if count < 2 or not math.isfinite(step) or step == 0.0:
        raise ValueError(f"{count} ranges at steps of {step:g} rad; expected two or more")
    count = min(count, int(2.0 * math.pi / abs(step) + 0.5))
    ends = -float(message.angle_min), -(float(message.angle_min) + (count - 1) * step)
    projection = Spherical(
        width=count, height=1, azimuth=centred(min(ends), max(ends)), elevation=(0.0, 0.0)
    )
    return Layout(projection=projection, R_cloud_sensor=BODY, flipped=(1,) if step > 0 else ())


def scan_image(message: Any, layout: Layout) -> NDArray[np.float32]:
    """The one row (m) of a ``LaserScan``; NaN where it measured nothing."""
    ranges = np.asarray(message.ranges, np.float32)[: layout.projection.width]
    inside = (ranges >= message.range_min) & (ranges <= message.range_max)
    return np.flip(np.where(inside, ranges, np.float32(np.nan))[None], layout.flipped).copy()
