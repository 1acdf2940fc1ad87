"""Pixels whose sides are curved are split until their parts' sides are nearly straight."""

import math

import numpy as np
import pytest
import torch
from scenes import CAMERA, LIDAR, at_rest, oracle_of, sensor_of, sheet, surface_of, wall

from torchcal.demo import raycast
from torchcal.geometry.projection import Projection, Spherical
from torchcal.render.parts import STRAIGHT, straight_parts
from torchcal.render.synthesis import synthesise

RMS = 1e-4  # m; a sixtieth of what straight sides would be off by


@pytest.mark.parametrize("beam", [1, 3])
def test_large_curved_pixels_see_the_area_that_many_rays_see(beam: int):
    """Sides of pixels of 3 degrees are bent: taken for straight they are off by up to 6 mm here."""
    step, parts = math.radians(3.0), 5
    azimuth, elevation = (0.0, 14 * step), (1.3, 1.3 - 8 * step)
    projection = Spherical(width=15, height=9, azimuth=azimuth, elevation=elevation)
    edge = sheet((-9.0, -9.0, 1.13), (9.0, -9.0, 1.13), (9.0, -2.5, 1.13), (-9.0, -2.5, 1.13))
    bodies = (edge, wall(3.0))
    surface = surface_of(*bodies)
    synthesis = synthesise(surface, at_rest(surface), sensor_of(projection, beam))
    means, shares = (
        fine.reshape(9, parts, 15, parts).mean((1, 3))
        for fine in raycast.sampled_means(
            oracle_of(*bodies), projection.divided(parts), raycast.FINE_LATTICE
        )
    )
    error = synthesis.range.numpy() - raycast.box_mean(means, shares, beam)
    assert np.sqrt(np.square(error).mean()) < RMS
    centres = synthesise(surface, at_rest(surface), sensor_of(projection, 0)).face
    assert torch.equal(synthesis.face, centres)


@pytest.mark.parametrize(
    ("projection", "beam", "parts"),
    [
        (CAMERA, 1, 1),
        (LIDAR, 0, 1),
        (LIDAR, 1, 7),
        (LIDAR.divided(7), 7, 1),
        (Spherical(width=1, height=3, azimuth=(0.0, 0.0), elevation=(STRAIGHT, -STRAIGHT)), 1, 1),
    ],
)
def test_only_areas_with_curved_sides_are_split(projection: Projection, beam: int, parts: int):
    """The steps of the spherical sensor are 1.8 degrees: seven parts are below 0.3 degrees."""
    assert straight_parts(sensor_of(projection, beam)) == parts
