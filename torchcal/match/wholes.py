"""What an image may show as one although the model has it in parts: coplanar and collinear ones."""

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.match.features import Lines, Planes

ANGLE, DISTANCE = 0.02, 0.02
"""rad and m within which no image tells two planes or lines apart."""


def whole_areas(planes: Planes) -> Float[Tensor, " plane"]:
    """The area (m^2) of each plane and all that are coplanar with it."""
    point, normal = planes.elements.point, planes.elements.direction
    along = (normal @ normal.mT) > 1.0 - 0.5 * ANGLE**2
    height = (normal @ point.mT - (normal * point).sum(-1, keepdim=True)).abs()
    return (along & (height < DISTANCE)).to(planes.area) @ planes.area


def whole_lengths(lines: Lines) -> Float[Tensor, " line"]:
    """From end to end (m) of all that is collinear with each line."""
    if len(lines.kind) == 0:
        return lines.length
    point, along = lines.elements.point, lines.elements.direction
    parallel = (along @ along.mT).abs() > 1.0 - 0.5 * ANGLE**2
    place = along @ point.mT - (along * point).sum(-1, keepdim=True)
    same = parallel & (torch.cdist(point, point).square() - place.square() < DISTANCE**2)
    half = 0.5 * lines.length
    high = torch.where(same, place + half, -torch.inf).amax(1)
    low = torch.where(same, place - half, torch.inf).amin(1)
    return high - low
