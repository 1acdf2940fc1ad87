"""What is left out because it is beside a spherical image, against points all over it."""

import math

import pytest
import torch
from torch import Tensor

from torchcal.geometry.projection import Spherical
from torchcal.render.boxes import are_beside, image_cone

THINGS = 4000


def sensor(azimuth_deg: tuple[float, float], elevation_deg: tuple[float, float]) -> Spherical:
    """A pixel is about a degree."""
    (left, right), (top, bottom) = azimuth_deg, elevation_deg
    return Spherical(
        width=int(abs(right - left)) + 1,
        height=int(abs(bottom - top)) + 1,
        azimuth=(math.radians(left), math.radians(right)),
        elevation=(math.radians(top), math.radians(bottom)),
    )


SENSORS = [
    sensor((-4.0, 4.0), (4.0, -4.0)),
    sensor((-30.0, 30.0), (30.0, -30.0)),
    sensor((100.0, 160.0), (-10.0, -70.0)),
    sensor((-170.0, 170.0), (40.0, -40.0)),
]


def drawn(corners: int, generator: torch.Generator) -> Tensor:
    """Things all round the sensor, from 1 cm to 10 m large."""
    shape = (THINGS, corners, 3)
    size = 10.0 ** (3.0 * torch.rand(THINGS, 1, 1, generator=generator).double() - 2.0)
    middle = 3.0 * torch.randn(THINGS, 1, 3, generator=generator).double()
    return middle + size * torch.randn(shape, generator=generator).double()


def reach_image(things: Tensor, projection: Spherical, generator: torch.Generator) -> Tensor:
    """Whether one of 400 points of each is seen by a pixel."""
    share = -torch.rand(400, things.shape[1], generator=generator).double().log()
    points = (share / share.sum(-1, keepdim=True)) @ things
    u, v = projection.pixels(points).unbind(-1)
    seen = (u > -0.5) & (u < projection.width - 0.5) & (v > -0.5) & (v < projection.height - 0.5)
    return seen.any(-1)


@pytest.mark.parametrize("projection", SENSORS, ids=["laser", "sonar", "aside", "round"])
@pytest.mark.parametrize("corners", [2, 3])
def test_nothing_that_is_seen_is_beside_the_image(projection, corners, rng):
    things = drawn(corners, rng)
    beside, seen = are_beside(things, projection), reach_image(things, projection, rng)
    assert seen.sum() > 10
    assert not (beside & seen).any()


def test_most_of_what_a_narrow_sensor_does_not_see_is_beside_the_image(rng):
    things = drawn(3, rng)
    assert are_beside(things, SENSORS[0]).double().mean() > 0.5


def test_what_touches_the_sensor_is_not_beside_the_image():
    behind = torch.tensor([[[0.0, 0.0, 0.0], [0.1, 0.0, -1.0], [-0.1, 0.1, -1.0]]]).double()
    around = torch.tensor([[[5.0, 0.1, -1.0], [-5.0, 0.1, -1.0], [0.0, -5.0, -1.0]]]).double()
    broken = torch.full((1, 3, 3), torch.nan).double()
    assert not are_beside(torch.cat([behind, around, broken]), SENSORS[0]).any()


@pytest.mark.parametrize("projection", SENSORS, ids=["laser", "sonar", "aside", "round"])
def test_all_rays_are_in_the_cone_of_the_image(projection):
    v, u = torch.meshgrid(
        torch.arange(projection.height).double(),
        torch.arange(projection.width).double(),
        indexing="ij",
    )
    axis, reach = image_cone(projection, u)
    assert (projection.rays(u, v) @ axis).clamp(-1, 1).acos().max() <= reach
