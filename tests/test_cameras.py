"""Lenses: OpenCV's models by kornia, and what becomes of an image behind one."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from kornia.geometry.calibration import distort_points

from torchcal.geometry.projection import Pinhole
from torchcal.model.recordings.cameras import Camera, camera_of

HOLE = Pinhole(width=64, height=48, fx=50.0, fy=52.0, cx=30.5, cy=24.0)
MATRIX = np.array([[50.0, 0.0, 30.5], [0.0, 52.0, 24.0], [0.0, 0.0, 1.0]])
PLUMB = (-0.21, 0.06, 0.002, -0.003, 0.01)
RATIONAL = (0.4, -0.2, 0.001, 0.0005, 0.03, 0.7, -0.1, 0.05)
NONE = (0.0,) * 12


def info(**more) -> SimpleNamespace:
    fields = {"width": 64, "height": 48, "k": MATRIX.ravel(), "d": (), "p": NONE}
    return SimpleNamespace(**{**fields, "distortion_model": "plumb_bob", **more})


def grid() -> np.ndarray:
    return np.stack(np.meshgrid(np.arange(64.0), np.arange(48.0)), -1)


@pytest.mark.parametrize(("lens", "d"), [("plumb_bob", PLUMB), ("rational_polynomial", RATIONAL)])
def test_pixels_are_taken_where_kornia_says(lens: str, d: tuple[float, ...]):
    camera = Camera(pinhole=HOLE, lens=lens, coefficients=d)
    dist = torch.tensor(d, dtype=torch.float64)
    points = torch.from_numpy(grid()).reshape(-1, 2)
    bent = distort_points(points, torch.from_numpy(MATRIX), dist).reshape(48, 64, 2).numpy()
    # An image whose pixels are their own column and row says where each was taken.
    columns, rows = (part.astype(np.float32) for part in np.moveaxis(grid(), -1, 0))
    taken = np.stack([camera.rectified(columns), camera.rectified(rows)], -1)
    rounded = np.rint(bent)
    inside = np.all((rounded >= 0) & (rounded < (64, 48)), -1)
    assert inside.mean() > 0.5
    np.testing.assert_array_equal(taken, np.where(np.expand_dims(inside, -1), rounded, 0.0))
    np.testing.assert_allclose(
        camera.largest_shift(), np.linalg.norm(bent - grid(), axis=-1).max(), rtol=1e-9
    )


def test_the_fisheye_without_coefficients_takes_the_angle_for_the_radius():
    camera = Camera(pinhole=HOLE, lens="equidistant", coefficients=(0.0, 0.0, 0.0, 0.0))
    column = camera.rectified(np.tile(np.arange(64, dtype=np.float32), (48, 1)))[24]
    by_hand = np.rint(50.0 * np.arctan((np.arange(64) - 30.5) / 50.0) + 30.5)
    np.testing.assert_array_equal(column, by_hand)


def test_integers_stay_integers_and_nothing_is_mixed():
    camera = Camera(pinhole=HOLE, lens="plumb_bob", coefficients=(0.5, 0.0, 0.0, 0.0, 0.0))
    image = np.where(grid()[..., 0] < 30, 1000, 3000).astype(np.uint16)
    rectified = camera.rectified(image)
    assert rectified.dtype == np.uint16
    assert set(np.unique(rectified)) == {0, 1000, 3000}  # 0: outside what the camera saw


def test_no_lens_is_no_change():
    image = np.random.default_rng(0).random((48, 64)).astype(np.float32)
    camera = camera_of(info(d=(0.0,) * 5), "/depth/image_raw")
    assert camera.rectified(image) is image
    assert camera.largest_shift() == 0.0


def test_a_rectified_topic_without_p_has_k():
    assert camera_of(info(), "/depth/image_rect").pinhole == HOLE


def test_an_unknown_lens_lists_the_known_ones():
    with pytest.raises(ValueError, match="'kannala'; expected plumb_bob, rational_polynomial"):
        camera_of(info(d=PLUMB, distortion_model="kannala"), "/depth/image_raw")


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"width": 0}, "a width of 0; expected whole pixels"),
        ({"k": np.where(MATRIX == 50.0, np.inf, MATRIX).ravel()}, "fx = inf; expected a focal"),
        ({"k": np.where(MATRIX == 30.5, np.nan, MATRIX).ravel()}, "cx = nan; expected the image's"),
        ({"d": (0.1, np.nan, 0.0, 0.0, 0.0)}, "coefficients .* of the lens; expected finite"),
    ],
)
def test_a_camera_that_cannot_be_is_a_mistake(more: dict, message: str):
    with pytest.raises(ValueError, match=message):
        camera_of(info(**more), "/camera/depth")


def test_a_lens_that_bends_beyond_all_numbers_leaves_the_middle():
    camera = camera_of(info(d=(1e200, 1e200, 0.0, 0.0, 1e300)), "/camera/depth")
    taken = camera.rectified(np.ones((48, 64), np.uint16))
    assert taken.sum() < 48 * 64
