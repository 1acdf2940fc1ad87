"""Vertexes of a range image: where three lines meet."""

import torch

from torchcal.match.elements import Elements
from torchcal.match.features import Lines, Vertices


def image_vertices(lines: Lines) -> Vertices:
    """Points where three lines meet near their ends."""
    new = lines.ends.new_zeros
    return Vertices(
        elements=Elements.points(new(0, 3), new(0, 3, 3)),
        lines=torch.zeros(0, 3, dtype=torch.long),
        angles=new(0, 3),
        angles_sigma=new(0, 3),
    )
