"""Flat sides become planes; bends and single wild pixels do not."""

import numpy as np
import torch
from wall_comparison import BOX, PINHOLE, SHAPE, scene, white

from torchcal.calibrate.flatten import flattened
from torchcal.geometry.projection import pixel_grid

SIGMA = 0.002  # m
RAYS = PINHOLE.rays(*pixel_grid(PINHOLE, dtype=torch.float64, device=torch.device("cpu"))).numpy()
INSIDE = np.zeros(SHAPE, bool)
INSIDE[BOX] = True


def slanted(slope):
    """A plane through 2.7 m on the axis whose depth grows by ``slope`` for each metre to x."""
    return 2.7 / (1.0 - slope * RAYS[..., 0])


def test_a_slanted_side_becomes_its_plane():
    truth = slanted(0.8)
    flat = flattened(truth + white(0, SIGMA), INSIDE, RAYS, SIGMA)
    # A plane through 3600 pixels is known to a few hundredths of their noise.
    # Of the border's pixels, which others do not surround, one in 370 is left beside it.
    assert np.quantile(np.abs(flat - truth)[INSIDE], 0.998) < 0.2 * SIGMA


def test_two_sides_become_two_planes():
    truth = np.maximum(slanted(1.5), slanted(-1.5))
    flat = flattened(truth + white(1, SIGMA), INSIDE, RAYS, SIGMA)
    off = np.abs(flat - truth)[INSIDE]
    # Beside the edge between them a pixel may be put onto the other plane, within its noise.
    assert np.median(off) < 0.2 * SIGMA
    assert off.max() < 4.0 * SIGMA


def test_a_round_side_stays_as_it_was_measured():
    ball = 2.7 - np.sqrt(np.maximum(0.3**2 - (2.7 * RAYS[..., :2]) ** 2 @ np.ones(2), 0.0))
    measured = ball + white(2, SIGMA)
    changed = flattened(measured, INSIDE, RAYS, SIGMA) != measured
    assert changed[INSIDE].mean() < 0.1


def test_what_is_outside_the_region_stays():
    measured = scene(2.7) + white(3, SIGMA)
    flat = flattened(measured, INSIDE, RAYS, SIGMA)
    np.testing.assert_array_equal(flat[~INSIDE], measured[~INSIDE])


def test_a_region_of_a_few_pixels_is_no_plane():
    few = np.zeros(SHAPE, bool)
    few[50:54, 70:75] = True
    measured = scene(2.7) + white(4, SIGMA)
    np.testing.assert_array_equal(flattened(measured, few, RAYS, SIGMA), measured)
