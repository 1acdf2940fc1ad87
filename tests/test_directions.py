"""Rotations from the directions of planes."""

import math

import pytest
import torch
from torch import Tensor

from torchcal.geometry import se3
from torchcal.match.directions import Directions, aligning_rotations

ROOM = torch.tensor(
    [[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [0.6, 0.8, 0]],
    dtype=torch.float64,
)
AREAS = torch.tensor([9.0, 9.0, 12.0, 12.0, 20.0, 20.0, 3.0], dtype=torch.float64)


def rotation(*vector: float) -> Tensor:
    return se3.exp(torch.tensor([0.0, 0.0, 0.0, *vector], dtype=torch.float64))[:3, :3]


def test_normals_that_are_near_count_as_one():
    tilted = rotation(0.0, 0.03, 0.0) @ ROOM[0]
    found = Directions.of(torch.stack([ROOM[0], tilted, ROOM[2]]), AREAS[:3], count=5)
    assert len(found.unit) == 2
    torch.testing.assert_close(found.weight, torch.tensor([18.0, 12.0]).double() / 30.0)
    assert float(found.unit[0] @ ROOM[0]) > math.cos(0.03)
    torch.testing.assert_close(found.unit.norm(dim=-1), torch.ones(2).double())


def test_no_more_directions_than_asked_for_the_heaviest_first():
    found = Directions.of(ROOM, AREAS, count=3)
    assert found.weight.tolist() == sorted(found.weight.tolist(), reverse=True)
    assert [round(float(w) * 85) for w in found.weight] == [20, 20, 12]


@pytest.mark.parametrize("vector", [(0.3, -0.8, 1.2), (3.0, 0.1, 0.2), (0.0, 0.0, 0.0)])
def test_the_true_rotation_is_among_those_found(vector: tuple[float, ...]):
    R_world_sensor = rotation(*vector)
    seen = ROOM[[0, 2, 5, 6]] @ R_world_sensor
    model = Directions.of(ROOM, AREAS, count=10)
    found = aligning_rotations(model, Directions.of(seen, AREAS[:4], count=4), count=60)
    errors = se3.rotation_log(R_world_sensor.mT @ found).norm(dim=-1)
    # Four directions without noise agree with no other rotation, and with this one exactly.
    assert float(errors[0]) < 1e-9


def test_a_box_alone_looks_alike_from_24_sides():
    cube = Directions.of(ROOM[:6], torch.ones(6).double(), count=6)
    corner = Directions.of(ROOM[[0, 2, 4]], torch.ones(3).double(), count=3)
    found = aligning_rotations(cube, corner, count=100)
    assert len(found) == 24
    torch.testing.assert_close(torch.linalg.det(found), torch.ones(24).double())


def test_one_direction_fixes_no_rotation():
    model = Directions.of(ROOM, AREAS, count=10)
    assert len(aligning_rotations(model, Directions.of(ROOM[:1], AREAS[:1], count=3), count=9)) == 0
    none = Directions.of(ROOM[:0], AREAS[:0], count=3)
    assert len(aligning_rotations(model, none, count=9)) == 0
