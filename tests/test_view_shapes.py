"""Points, frustum and ellipsoid of the view: known answers."""

import dataclasses

import numpy as np
import pytest
import torch
from display_scene import HEIGHT, REGIONS, WIDTH, comparison

from torchcal.calibrate.result import PixelClass
from torchcal.display.colours import class_image
from torchcal.display.view import shapes
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole, Spherical

LENS = Pinhole(width=WIDTH, height=HEIGHT, fx=60.0, fy=60.0, cx=31.5, cy=23.5)


def pixels_of(points: shapes.Points) -> np.ndarray:
    uv = LENS.pixels(torch.from_numpy(points.positions)).numpy()
    np.testing.assert_allclose(uv, np.round(uv), atol=1e-9)
    return np.round(uv).astype(int)


def test_points_stand_where_they_were_measured_in_the_colour_of_their_class():
    frame = comparison()
    points = shapes.class_points(frame, LENS)
    u, v = pixels_of(points).T
    label, measured = frame.label.numpy(), frame.measured.numpy()
    np.testing.assert_array_equal(points.colours, class_image(label)[v, u])
    seen = label[v, u] != PixelClass.MISSING
    np.testing.assert_allclose(points.positions[seen, 2], measured[v, u][seen], rtol=1e-12)


def test_every_compared_pixel_has_a_point_and_missing_ones_stand_on_the_model():
    frame = comparison()
    points = shapes.class_points(frame, LENS)
    assert len(points.positions) == int((frame.label != PixelClass.NOT_COMPARED).sum())
    u, v = pixels_of(points).T
    missing = REGIONS[PixelClass.MISSING].numpy()[v, u]
    assert missing.sum() == 140
    predicted = frame.predicted.numpy()[v, u]
    np.testing.assert_allclose(points.positions[missing, 2], predicted[missing], rtol=1e-12)


def test_raw_points_do_not_depend_on_the_model():
    frame = comparison()
    nothing = torch.full_like(frame.predicted, torch.nan)
    blind = dataclasses.replace(frame, predicted=nothing, label=torch.zeros_like(frame.label))
    for one, other in zip(
        dataclasses.astuple(shapes.range_points(frame, LENS)),
        dataclasses.astuple(shapes.range_points(blind, LENS)),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)
    count = int(frame.measured.isfinite().sum())
    assert len(shapes.range_points(frame, LENS).positions) == count


def test_large_images_are_thinned_evenly(monkeypatch):
    monkeypatch.setattr(shapes, "MOST_POINTS", 200)
    u, _ = pixels_of(shapes.class_points(comparison(), LENS)).T
    assert 100 < len(u) <= 200
    assert len(set(np.diff(np.unique(u)))) == 1


def test_a_frustum_goes_through_the_corners_of_the_image():
    lines = shapes.frustum(LENS, 0.5)
    corners = LENS.pixels(torch.from_numpy(lines[:4, 1])).numpy()
    right, below = WIDTH - 0.5, HEIGHT - 0.5
    expected = [(-0.5, -0.5), (right, -0.5), (right, below), (-0.5, below)]
    np.testing.assert_allclose(corners, expected, atol=1e-9)
    np.testing.assert_array_equal(lines[:4, 0], 0.0)
    np.testing.assert_allclose(lines[:4, 1, 2], 0.5)
    rim = lines[4:]
    np.testing.assert_array_equal(rim[:, 1], np.roll(rim[:, 0], -1, axis=0))


def test_the_rim_of_a_spherical_sensor_keeps_its_distance():
    lens = Spherical(width=9, height=5, azimuth=(-1.0, 1.0), elevation=(0.5, -0.5))
    rim = shapes.frustum(lens, 2.0)[4:]
    np.testing.assert_allclose(np.linalg.norm(rim, axis=-1), 2.0)


@pytest.mark.parametrize("seed", range(3))
def test_three_sigma_of_the_position_lie_on_the_ellipsoid(seed):
    rng = np.random.default_rng(seed)
    turn = se3.exp(torch.from_numpy(np.r_[0, 0, 0, rng.standard_normal(3)]))[:3, :3].numpy()
    sigmas = np.array([0.002, 0.03, 0.01])
    P = torch.zeros(6, 6, dtype=torch.float64)
    P[:3, :3] = torch.from_numpy(turn @ np.diag(sigmas**2) @ turn.T)
    found = shapes.ellipsoid(P)
    np.testing.assert_allclose(found.radii, [0.09, 0.03, 0.006], rtol=1e-6)
    R = found.R_sensor_ellipsoid
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) > 0.0
    P_again = R @ np.diag((found.radii / 3.0) ** 2) @ R.T
    np.testing.assert_allclose(P_again, P[:3, :3].numpy(), atol=1e-12)


def test_a_position_that_is_known_exactly_is_a_point():
    assert shapes.ellipsoid(torch.zeros(6, 6, dtype=torch.float64)).radii.max() == 0.0
