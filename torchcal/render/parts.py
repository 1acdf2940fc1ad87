"""Large pixels with curved sides as sums of smaller ones with sides that are nearly straight."""

import math
from dataclasses import replace

import torch

from torchcal.model.sensor import Sensor

STRAIGHT = math.radians(0.3)
"""The sides of a pixel of this width (rad) are straight enough: what is seen between a side and its
chord changes a range by less than a millimetre at a depth jump of several metres."""


def straight_parts(sensor: Sensor) -> int:
    """Along each side of a pixel: into how many parts it is split so that their sides are straight.

    Odd, so that one part has the pixel's middle. Areas are cut by straight lines (``squares.py``);
    where a sensor's pixels are large and their sides are curved, smaller ones are added up.
    """
    projection = sensor.projection
    like = torch.zeros((), dtype=torch.float64)
    u, v = (
        torch.tensor([0.0, 0.5, 1.0]).to(like) * (size - 1)
        for size in (projection.width, projection.height)
    )
    u, v = torch.meshgrid(u, v, indexing="xy")
    if sensor.beam == 0 or projection.ray_curvatures(u, v) is None:
        return 1
    widest = max(float(side.norm(dim=-1).max()) for side in projection.ray_derivatives(u, v))
    return 2 * math.ceil((widest / STRAIGHT - 1.0) / 2.0) + 1 if widest > STRAIGHT else 1


def divided(sensor: Sensor, parts: int) -> Sensor:
    """The same sensor, each pixel split into ``parts`` x ``parts``; its beam is as wide."""
    if parts == 1:
        return sensor
    projection = sensor.projection.divided(parts)
    return replace(sensor, projection=projection, beam=parts * sensor.beam)
