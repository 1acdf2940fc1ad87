"""Places along lines at equal steps of an image."""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from torchcal.geometry.projection import Projection

STEP = 2.0
"""Pixels between places."""
BESIDE = 1.5
"""Pixels: how far beside a line an image is looked at."""
CLOSE = 0.05
"""m: lines are cut off where they come nearer to the sensor."""


@dataclass(frozen=True, kw_only=True, slots=True)
class Places:
    """Places on lines, one line after the other."""

    line: Int[Tensor, " place"]
    share: Float[Tensor, " place"]
    """Where on its line: 0 to 1."""
    point: Float[Tensor, "place 3"]
    """In the sensor's frame (m)."""
    pixel: Float[Tensor, "place 2"]
    across: Float[Tensor, "place 2"]
    """Of unit length in the image, across the line."""
    step: Float[Tensor, " place"]
    """Pixels of the line that the place stands for; 0 outside the image."""


def places_along(ends: Float[Tensor, "line 2 3"], projection: Projection) -> Places:
    """Places at steps of about ``STEP`` pixels on lines in the sensor's frame (m)."""
    a, b, low, high = _before_sensor(ends, projection)
    exists = high > low
    rough = (projection.pixels(a) - projection.pixels(b)).norm(dim=-1)
    most = 2 * (projection.width + projection.height)
    count = (rough.nan_to_num(0.0, 0.0) / STEP).clamp(2, most).ceil().long() * exists
    line = torch.repeat_interleave(torch.arange(len(count), device=a.device), count)
    place = torch.arange(len(line), device=a.device) - (count.cumsum(0) - count)[line]
    turn = (place + 0.5) / count[line]
    near, far = turn / b.norm(dim=-1)[line], (1.0 - turn) / a.norm(dim=-1)[line]
    part = near / (near + far)
    point = a[line] + part[:, None] * (b - a)[line]
    pixel = projection.pixels(point)
    ahead = projection.pixels(point + 1e-4 * (b - a)[line]) - pixel
    along = torch.nn.functional.normalize(ahead, dim=-1)
    u, v = pixel.unbind(-1)
    inside = (u > BESIDE) & (v > BESIDE)
    inside &= (u < projection.width - 1 - BESIDE) & (v < projection.height - 1 - BESIDE)
    speed = ahead.norm(dim=-1) * 1e4
    derivative = part * (1.0 - part) / (turn * (1.0 - turn)) / count[line]
    return Places(
        line=line,
        share=low[line] + part * (high - low)[line],
        point=point,
        pixel=pixel,
        across=torch.stack([-along[:, 1], along[:, 0]], -1),
        step=torch.where(inside, speed * derivative, 0.0),
    )


def _before_sensor(ends: Tensor, projection: Projection) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Lines cut off where their range is below ``CLOSE``, and the shares at which they are cut."""
    a, b = ends.unbind(1)
    near_a, near_b = projection.ranges(a) - CLOSE, projection.ranges(b) - CLOSE
    cut = near_a / (near_a - near_b)
    low = torch.where(near_a > 0.0, 0.0, torch.where(near_b > 0.0, cut, 1.0))
    high = torch.where(near_b > 0.0, 1.0, torch.where(near_a > 0.0, cut, 0.0))
    return a + low[:, None] * (b - a), a + high[:, None] * (b - a), low, high
