"""Significant regions: found where something changed, and nowhere else."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from wall_comparison import (
    BOX,
    DEPTH_CAMERA,
    NOISY,
    SHAPE,
    WALL,
    comparison,
    drift,
    scene,
    white,
)

from torchcal.calibrate.regions import (
    FALSE_REGIONS_PER_IMAGE,
    RegionKind,
    chance_threshold,
    connected_regions,
    local_difference,
    significant_regions,
    steepness,
)
from torchcal.model.sensor import Noise

SEEDS = range(10)
DRIFTING = math.hypot(0.002, 0.003)
BOX_CENTRE = torch.tensor([79.5, 99.5], dtype=torch.float64)


def noisy_regions(measured, predicted, seed):
    frame = comparison(measured + white(seed), predicted, 0.05)
    return significant_regions(frame, NOISY, correlation_pixels=0.0)


def drifting_regions(measured, predicted, seed, **kwargs):
    noise = drift(seed) + white(seed + 100, 0.002)
    frame = comparison(measured + noise, predicted, DRIFTING, **kwargs)
    return significant_regions(frame, DEPTH_CAMERA, correlation_pixels=30.0)


def centre(mask):
    return mask.nonzero().double().mean(0)


def test_pixels_that_touch_at_a_corner_are_connected():
    mask = torch.tensor([[1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 0, 1]], dtype=torch.bool)
    expected = torch.tensor([[1, 0, 0, 0], [0, 1, 0, 2], [0, 0, 0, 2]])
    torch.testing.assert_close(connected_regions(mask), expected)


@pytest.mark.parametrize("seed", SEEDS)
def test_independent_noise_makes_no_region(seed):
    assert noisy_regions(scene(), scene(), seed) == ()


@pytest.mark.parametrize("seed", SEEDS)
def test_drift_makes_no_region_although_it_is_smooth(seed):
    assert drifting_regions(scene(), scene(), seed) == ()


@pytest.mark.parametrize("seed", SEEDS)
def test_a_box_in_strong_noise_is_one_region_of_its_size(seed):
    (found,) = noisy_regions(scene(2.7, beam=21), scene(), seed)
    assert found.kind == RegionKind.NEARER
    # 4 pixels are 2 cm; 60 x 60 pixels within a tenth, for the half maximum rounds the corners.
    torch.testing.assert_close(centre(found.mask), BOX_CENTRE, atol=4.0, rtol=0.0)
    assert found.pixels == pytest.approx(3600, rel=0.1)
    assert found.bodies == {0: found.pixels}


@pytest.mark.parametrize("seed", SEEDS)
def test_a_step_of_one_sigma_is_found_as_a_region(seed):
    (found,) = noisy_regions(scene(WALL - 0.05, beam=21), scene(), seed)
    torch.testing.assert_close(centre(found.mask), BOX_CENTRE, atol=6.0, rtol=0.0)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_thing_of_three_centimetres_is_found_through_drift(seed):
    (found,) = drifting_regions(scene(WALL - 0.03), scene(), seed)
    torch.testing.assert_close(centre(found.mask), BOX_CENTRE, atol=1.0, rtol=0.0)
    assert found.pixels == pytest.approx(3600, rel=0.1)


def test_a_box_that_is_gone_is_a_farther_region():
    (found,) = noisy_regions(scene(), scene(2.7, beam=21), seed=0)
    assert found.kind == RegionKind.FARTHER
    torch.testing.assert_close(centre(found.mask), BOX_CENTRE, atol=4.0, rtol=0.0)


def test_a_line_of_wild_pixels_is_no_region():
    measured = scene()
    measured[40:42] = 1.0
    assert drifting_regions(measured, scene(), seed=0) == ()


def test_an_edge_half_a_pixel_off_is_no_region():
    sharp = scene(1.5)
    measured = 0.5 * (sharp + np.roll(sharp, 1, axis=1))
    assert drifting_regions(measured, sharp, seed=0) == ()


def test_pixels_outside_the_mask_are_in_no_region():
    usable = torch.ones(SHAPE, dtype=torch.bool)
    usable[:, :100] = False
    (found,) = drifting_regions(scene(2.7), scene(), seed=0, usable=usable)
    assert not found.mask[:, :100].any()
    assert found.mask[80, 110]


def test_what_is_measured_where_the_model_is_empty_is_an_unmodelled_region():
    model = scene()
    model[BOX] = np.nan
    (found,) = drifting_regions(scene(2.7), model, seed=0)
    assert found.kind == RegionKind.UNMODELLED
    assert found.pixels == 3600
    assert found.bodies == {}
    assert found.significance == math.inf


def test_missing_pixels_do_not_break_the_averages():
    measured = scene(2.7)
    measured[np.random.default_rng(0).random(SHAPE) < 0.3] = np.nan
    (found,) = drifting_regions(measured, scene(), seed=0)
    torch.testing.assert_close(centre(found.mask), BOX_CENTRE, atol=1.0, rtol=0.0)


def test_an_image_without_any_measurement_has_no_region():
    assert drifting_regions(np.full(SHAPE, np.nan), scene(), seed=0) == ()


def test_single_precision_gives_the_same_regions():
    frame = comparison(scene(2.7, beam=21) + white(0), scene(), 0.05)
    single = replace(
        frame,
        measured=frame.measured.float(),
        predicted=frame.predicted.float(),
        sigma=frame.sigma.float(),
    )
    (one,), (other,) = (
        significant_regions(f, NOISY, correlation_pixels=0.0) for f in (frame, single)
    )
    # A pixel that lies on a threshold may fall to either side of it.
    assert (one.mask ^ other.mask).sum() <= 3


def test_sigma_of_the_local_mean_is_its_spread_in_white_noise():
    local = local_difference(comparison(scene() + white(0), scene(), 0.05), NOISY)
    middle = (slice(10, -10), slice(10, -10))
    assert local.sigma[80, 100] == pytest.approx(1.0 / 11.0, rel=1e-6)
    # The image holds about 200 windows of 11 x 11 pixels: their spread is known to 5 %.
    assert local.mean[middle].std() == pytest.approx(1.0 / 11.0, rel=0.15)


def test_the_common_part_of_sigma_does_not_average_out():
    local = local_difference(comparison(scene(), scene(), DRIFTING), DEPTH_CAMERA)
    share = (0.002 / DRIFTING) ** 2
    assert local.sigma[80, 100] == pytest.approx(math.sqrt(share / 25 + 1 - share), rel=1e-6)


def test_the_threshold_lets_one_region_pass_in_a_hundred_images():
    z = chance_threshold(200_000, 5, 30.0)
    expected = 2 * 200_000 / 900 * (2 * math.pi) ** -1.5 * z * math.exp(-0.5 * z * z)
    assert expected == pytest.approx(FALSE_REGIONS_PER_IMAGE, rel=1e-9)


def test_steepness_is_the_largest_step_to_a_neighbour():
    ranges = np.array([[1.0, 1.0, 4.0], [1.0, 5.0, np.nan]])
    expected = np.array([[0.0, 5.0, 3.0], [4.0, math.hypot(4.0, 4.0), 0.0]])
    np.testing.assert_allclose(steepness(ranges), expected)


ARC_BIN = Path(__file__).parents[2] / "shared" / "jobs" / "arc_bin"


@pytest.mark.skipif(not ARC_BIN.exists(), reason=f"the recording {ARC_BIN} is not here")
def test_whisk_torch_and_scissors_are_found_in_a_real_bin():
    def ranges(file):
        image = torch.from_numpy(np.asarray(Image.open(ARC_BIN / file)).astype(float)) * 1e-4
        return torch.where((image > 0.3) & (image < 2.0), image, torch.nan)

    # The camera stood still: the image of the empty bin is what a perfect model predicts.
    measured, predicted = ranges("filled.png"), ranges("empty.png")
    sensor = replace(DEPTH_CAMERA, noise=Noise(a=0.001, c=0.003))
    sigma = torch.hypot(sensor.noise.sigma(predicted), torch.full_like(predicted, 0.003))
    frame = comparison(measured.numpy(), predicted.numpy(), sigma)
    found = significant_regions(frame, sensor, correlation_pixels=30.0)
    nearer = [region.mask for region in found if region.kind == RegionKind.NEARER]
    # Row and column of a point on each, read from the picture.
    for thing in ((230, 370), (312, 310), (400, 320)):
        assert any(mask[thing] for mask in nearer), thing
    # Two regions are things that moved outside the bin, two a goblet and a piece of the scissors.
    assert len(nearer) <= 10
