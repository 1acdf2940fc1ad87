"""Positions at which a cloud of points lies on a surface."""

import pytest
import scenes
import torch
from torch import Tensor

from torchcal.match.volume import CELLS, Volume, peaks


def triangles(*meshes) -> Tensor:
    return torch.cat([torch.as_tensor(mesh.triangles.copy()) for mesh in meshes]).float()


ROOM = triangles(
    scenes.box((5.0, 4.0, 3.0), (0.0, 0.0, 0.0)), scenes.box((1.0, 0.6, 0.8), (1.2, -0.7, -1.0))
)


def drawn(surface: Tensor, count: int, rng: torch.Generator) -> Tensor:
    """Points on triangles, as many on each."""
    share = torch.rand(len(surface), count, 2, generator=rng)
    share = torch.where(share.sum(-1, keepdim=True) > 1.0, 1.0 - share, share)
    a, b, c = surface.unbind(1)
    sides = torch.stack([b - a, c - a], 1)
    return (a[:, None] + share @ sides).flatten(0, 1)


@pytest.mark.parametrize("place", [(0.4, 0.3, 0.2), (-1.5, 1.0, -0.7)])
def test_the_best_position_is_where_the_points_were_seen_from(place, rng):
    volume = Volume.of(ROOM, rng)
    origin = torch.tensor(place)
    offsets = drawn(ROOM, 100, rng) - origin
    values, index = peaks(volume.scores(offsets), 5)
    found = volume.places(index, offsets)
    # Half a cell's diagonal is 0.87 of its side.
    assert float((found[0] - origin).norm()) < 1.0 * volume.side
    assert values.tolist() == sorted(values.tolist(), reverse=True)
    assert volume.side == pytest.approx(5.0 / CELLS)


def test_a_position_outside_of_the_model_is_found(rng):
    thing = ROOM[12:]
    volume = Volume.of(thing, rng)
    origin = torch.tensor([1.0, -3.5, 0.5])
    offsets = drawn(thing, 100, rng) - origin
    values, index = peaks(volume.scores(offsets), 1)
    found = volume.places(index, offsets)
    assert len(values) == 1
    assert float((found[0] - origin).norm()) < 2.0 * volume.side


def test_a_wall_in_between_costs(rng):
    """Rays of 1.5 m from z = 1.5 end on the back wall; those from -1/3 cross the front one.

    A third wall behind both makes the volume longer than the rays.
    """
    walls = [scenes.wall(z, side=2.0) for z in (-1.5, 1.0, 3.0)]
    volume = Volume.of(triangles(*walls), rng)
    points = drawn(triangles(scenes.wall(0.0, side=1.0)), 400, rng)

    def best_at(z: float) -> float:
        scores = volume.scores(points + torch.tensor([0.0, 0.0, 3.0 - z]))
        heights = volume.origin[2] + volume.side * torch.arange(scores.shape[2])
        length = volume.side * volume.size[2]
        away = (heights - z + 0.5 * length) % length - 0.5 * length
        return float(scores[..., away.abs() < 1.5 * volume.side].max())

    assert best_at(1.5) > 0.8
    assert best_at(-1.0 / 3.0) < best_at(1.5) - 0.05
