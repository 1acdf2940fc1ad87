"""The hybrid view: which source every pixel shows, and how anybody sees which."""

import dataclasses

import numpy as np
import pytest
import torch
from display_scene import REGIONS, comparison

from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.display import colours, hybrid, legend

MODEL_BYTE = round(179 * (0.5 + 0.5 * 0.8))
"""Red of the scene's model (179) where its normal is turned 0.8 to the lamp."""


def inner(member: PixelClass) -> tuple[int, int]:
    """A pixel in the middle of a region."""
    rows, columns = torch.where(REGIONS[member])
    return int(rows.float().mean()), int(columns.float().mean())


def test_model_is_shown_shaded_where_it_agrees():
    assert hybrid.hybrid_image(comparison())[30, 5, 0] == MODEL_BYTE


@pytest.mark.parametrize("member", hybrid.MEASURED_CLASSES)
def test_measurement_is_shown_where_the_model_is_not_to_be_trusted(member):
    frame, (row, column) = comparison(), inner(member)
    low, high = hybrid.hybrid_limits(frame)
    share = (float(frame.measured[row, column]) - low) / (high - low)
    expected = 255.0 * np.array(colours.RANGE_MAP(share)[:3])
    region = hybrid.hybrid_image(frame)[row - 2 : row + 2, column - 2 : column + 3].astype(float)
    # One of 256 steps and rounding to bytes; another pixel than the middle may be on a line.
    assert np.abs(region - expected).max(-1).min() <= 4.0


def test_missing_pixels_show_the_model_dimmed_under_level_lines():
    rows, columns = (each.numpy() for each in torch.where(REGIONS[PixelClass.MISSING]))
    shown = hybrid.hybrid_image(comparison())
    lines = (shown == colours.as_bytes(colours.CLASS_COLOURS[PixelClass.MISSING])).all(-1)
    assert (shown[rows, columns, 0] == MODEL_BYTE // 2).mean() > 0.7
    np.testing.assert_array_equal(np.flatnonzero(lines.any(1)), [9])
    assert lines[9, columns.min() : columns.max() + 1].all()


def test_nothing_is_shown_where_nothing_was_compared():
    shown = hybrid.hybrid_image(comparison())[46, 10]
    np.testing.assert_array_equal(shown, colours.as_bytes(colours.NEUTRAL))


def test_measured_regions_are_outlined_in_the_colour_of_their_class():
    image = hybrid.hybrid_image(comparison())
    rim = colours.as_bytes(colours.CLASS_COLOURS[PixelClass.NEARER])
    # Not their corners: an outline is round.
    np.testing.assert_array_equal(image[10, 9:21], np.broadcast_to(rim, (12, 3)))
    np.testing.assert_array_equal(image[11:21, 8], np.broadcast_to(rim, (10, 3)))
    assert not (image[9] == rim).all(-1).any()


def with_label(row: int, column: int, side: int, member: PixelClass) -> FrameComparison:
    """The scene with a square of another class."""
    frame = comparison()
    label = frame.label.clone()
    label[row : row + side, column : column + side] = member
    return dataclasses.replace(frame, label=label)


def test_a_speckle_keeps_its_measured_colour():
    image = hybrid.hybrid_image(with_label(30, 6, 1, PixelClass.NEARER))
    rim = colours.as_bytes(colours.CLASS_COLOURS[PixelClass.NEARER])
    assert not np.array_equal(image[30, 6], rim)
    assert image[30, 6, 0] != MODEL_BYTE


def test_an_enlarged_pixel_is_outlined_and_still_seen():
    frame = with_label(30, 6, 1, PixelClass.NEARER)
    pixel = hybrid.hybrid_image(frame, (12, 12))[360:372, 72:84]
    rim = (pixel == colours.as_bytes(colours.CLASS_COLOURS[PixelClass.NEARER])).all(-1)
    assert rim[0, 4:8].all()
    assert not rim[4:8, 4:8].any()


def test_an_outline_follows_a_region_and_not_the_noise_on_its_border():
    frame = comparison()
    label = frame.label.clone()
    label[9, 9:21:2] = PixelClass.NEARER
    image = hybrid.hybrid_image(dataclasses.replace(frame, label=label))
    rim = colours.as_bytes(colours.CLASS_COLOURS[PixelClass.NEARER])
    assert not (image[8] == rim).all(-1).any()
    assert (image[10:12, 9:21] == rim).all(-1).any(0).all()


@pytest.mark.parametrize("member", hybrid.MEASURED_CLASSES)
def test_measured_classes_are_hatched_each_in_its_own_way(member):
    """Along rows, columns and both diagonals: only across its lines does a hatching change."""
    lines = legend.hybrid_swatch(member, line=1)[8:26, 8:26].astype(int).mean(-1)
    scale = np.median(lines, axis=0)
    on = np.abs(lines - scale) > 20
    rising = on[1:, :-1] == on[:-1, 1:]
    falling = on[1:, 1:] == on[:-1, :-1]
    assert on.any()
    assert rising.all() == (member == PixelClass.NEARER)
    assert falling.all() == (member == PixelClass.FARTHER)


def test_class_colours_are_all_different():
    image = colours.class_image(np.arange(len(PixelClass), dtype=np.uint8)[None])
    assert len({tuple(pixel) for pixel in image[0]}) == len(PixelClass)


def test_range_limits_of_nothing_and_of_a_flat_wall_are_intervals():
    assert colours.range_limits(np.full((2, 2), np.nan)) == (0.0, 1.0)
    low, high = colours.range_limits(np.full((2, 2), 3.0))
    assert low < 3.0 < high
