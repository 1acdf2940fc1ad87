"""The pictures: which source every pixel shows, and figures that can be drawn of anything."""

import dataclasses
import tomllib

import numpy as np
import pytest
import torch
from display_scene import HEIGHT, REGIONS, WIDTH, calibration, comparison, estimate
from matplotlib.colors import to_rgb

from torchcal.calibrate.result import NextView, PixelClass
from torchcal.display import canvas, colours, figures, hybrid
from torchcal.display.summary import axis_sigmas, corrections, next_view_words, settings

MODEL_BYTE = round(255 * 0.7 * (0.35 + 0.65 * 0.8))
"""Red of the scene's model (0.7) where its normal is turned 0.8 to the lamp."""


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
    shown = hybrid.hybrid_image(frame)[row, column].astype(float)
    np.testing.assert_allclose(shown, expected, atol=1.0)  # rounding to bytes


def test_missing_pixels_show_the_model_dimmed_and_hatched():
    rows, columns = torch.where(REGIONS[PixelClass.MISSING])
    red = hybrid.hybrid_image(comparison())[rows, columns, 0]
    assert red.max() < 0.7 * MODEL_BYTE
    assert len(np.unique(red)) == 2


def test_nothing_is_shown_where_nothing_was_compared():
    shown = hybrid.hybrid_image(comparison())[46, 10]
    np.testing.assert_array_equal(shown, np.round(255 * np.array(to_rgb(colours.NEUTRAL))))


def test_measured_regions_are_outlined_in_the_colour_of_their_class():
    image = hybrid.hybrid_image(comparison())
    rim = np.round(255 * np.array(to_rgb(colours.CLASS_COLOURS[PixelClass.NEARER])))
    np.testing.assert_array_equal(image[10, 8:22], np.broadcast_to(rim, (14, 3)))


def test_a_speckle_keeps_its_measured_colour():
    frame = comparison()
    label = frame.label.clone()
    label[30, 5] = PixelClass.NEARER
    image = hybrid.hybrid_image(dataclasses.replace(frame, label=label))
    rim = np.round(255 * np.array(to_rgb(colours.CLASS_COLOURS[PixelClass.NEARER])))
    assert not np.array_equal(image[30, 5], rim)
    assert image[30, 5, 0] != MODEL_BYTE


def test_class_colours_are_all_different():
    image = colours.class_image(np.arange(len(PixelClass))[None])
    assert len({tuple(pixel) for pixel in image[0]}) == len(PixelClass)


def test_range_limits_of_nothing_and_of_a_flat_wall_are_intervals():
    assert colours.range_limits(np.full((2, 2), np.nan)) == (0.0, 1.0)
    low, high = colours.range_limits(np.full((2, 2), 3.0))
    assert low < 3.0 < high


def test_counts_add_up_to_the_image():
    counts = figures.class_counts(comparison())
    assert sum(counts.values()) == HEIGHT * WIDTH
    assert counts[PixelClass.NEARER] == 12 * 14


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_figures_of_both_dtypes_are_drawn_with_more_than_one_colour(dtype):
    frame = comparison(dtype=dtype)
    for figure in (figures.hybrid_figure(frame), figures.comparison_figure(frame, 3.0)):
        picture = np.asarray(canvas.pixels(figure))
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 50


def test_figures_of_a_frame_without_anything_are_drawn():
    frame, nan = comparison(), torch.full((HEIGHT, WIDTH), torch.nan, dtype=torch.float64)
    label = torch.zeros(HEIGHT, WIDTH, dtype=torch.int64)
    empty = dataclasses.replace(frame, measured=nan, predicted=nan, sigma=nan, label=label)
    for figure in (
        figures.hybrid_figure(empty),
        figures.comparison_figure(empty, 3.0),
        figures.range_figure(nan, "nothing"),
    ):
        assert canvas.pixels(figure).width > 100


def test_one_image_pixel_covers_whole_figure_pixels():
    assert canvas.displayed_size((48, 64), 720) == (704, 528)


def test_images_of_a_lidar_with_few_rows_are_stretched():
    width, height = canvas.displayed_size((16, 1024), 720)
    assert width == 720
    assert height == 180


def test_held_axes_have_no_sigma():
    found = estimate(1)
    sigmas = axis_sigmas(found.names, found.covariance, "base")
    assert sigmas[2] == 0.0
    np.testing.assert_allclose(sigmas, [0.001, 0.002, 0.0, 0.0003, 0.0004, 0.0005], rtol=1e-12)


def test_corrections_are_in_mm_and_degrees():
    (pose,) = corrections(calibration())
    changes = {row.axis: row.change for row in pose.axes}
    np.testing.assert_allclose(changes["x"], 10.0, rtol=1e-6)  # 0.01 m; kornia's quaternions
    np.testing.assert_allclose(changes["rz"], np.degrees(0.0349), rtol=1e-6)
    assert [row.axis for row in pose.axes if row.held] == ["z"]


def test_settings_name_sensor_and_prior_with_units():
    words = settings(calibration().job)
    assert words["Sensor"] == "pinhole, depth along z, 64 × 48 pixels"
    assert words["Prior of the sensor's pose"] == "100, 100, 0 mm, 2.865°"


def test_settings_of_a_hand_held_sensor_know_no_base_and_no_mount():
    assert not [key for key in settings(calibration().job) if "base" in key or "mount" in key]


def test_of_a_hand_held_sensor_that_is_wrong_alike_in_all_frames_the_first_pose_is_shown():
    (shown,) = corrections(calibration())
    assert shown.title == "Sensor in the world (first frame; the others move with it)"


def test_of_a_hand_held_sensor_every_pose_that_had_its_own_error_is_shown():
    found = calibration()
    prior = found.job.base
    of_frames = dataclasses.replace(found.job, base=None, frame_poses=prior)
    first, second = corrections(dataclasses.replace(found, job=of_frames))
    assert first.title == "Sensor in the world, frame 0001"
    assert second.title == "Sensor in the world, frame 0002"
    assert first.axes == corrections(found)[0].axes
    assert second.axes == first.axes  # the scene's frames are alike


def test_the_next_view_is_toml_whatever_its_joints_are_called():
    joints = {"nod": 0.5, "arm/joint.1 a": -1.0, 'say "x"': 0.25}
    words = next_view_words(NextView(joints=joints, gain=1.0, sigma={}))
    assert tomllib.loads(words) == {"joints": joints}
