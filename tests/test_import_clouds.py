"""Scans and clouds: the same range images come back that the points were made of."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from bags import KINDS, Messages, write_bag
from walls import HOLE, SCANNER, numbers_of, points, wall

from torchcal.errors import JobError
from torchcal.geometry.projection import Spherical, pixel_grid
from torchcal.model.recordings.cloud_images import cloud_images
from torchcal.model.recordings.import_recording import Imported, import_recording
from torchcal.model.recordings.layout import BODY, OPTICAL
from torchcal.model.recordings.scans import scan_image, scan_layout


@pytest.mark.parametrize("axes", [OPTICAL, BODY], ids=["optical", "body"])
@pytest.mark.parametrize("projection", [HOLE, SCANNER], ids=["pinhole", "spherical"])
def test_an_organised_cloud_is_the_image_it_was_made_of(projection: Any, axes: np.ndarray):
    image = wall(projection)
    image[3:6, 4:9] = np.nan
    cloud = points(projection, image, axes)
    made = cloud_images(lambda: [cloud], None)
    assert type(made.layout.projection) is type(projection)
    for name in projection.__dataclass_fields__:
        np.testing.assert_allclose(
            getattr(made.layout.projection, name), getattr(projection, name), atol=1e-9
        )
    np.testing.assert_array_equal(made.layout.R_cloud_sensor, axes)
    np.testing.assert_allclose(made.image(cloud), image, rtol=1e-6)


@pytest.mark.parametrize("flipped", [(0,), (1,), (0, 1)])
def test_a_scanner_may_run_the_other_way(flipped: tuple[int, ...]):
    image = wall(SCANNER)
    cloud = np.flip(points(SCANNER, image, BODY), flipped)
    made = cloud_images(lambda: [cloud], None)
    assert isinstance(made.layout.projection, Spherical)
    np.testing.assert_allclose(made.layout.projection.azimuth, SCANNER.azimuth, atol=1e-9)
    np.testing.assert_allclose(made.image(cloud), image, rtol=1e-6)


def test_a_scanner_may_see_the_whole_turn():
    step = 2.0 * math.pi / 90
    whole = Spherical(width=90, height=8, azimuth=(-3.1, -3.1 + 89 * step), elevation=(0.2, -0.3))
    image = np.random.default_rng(0).uniform(1.0, 9.0, (8, 90))
    cloud = points(whole, image, BODY)
    made = cloud_images(lambda: [cloud], None)
    projection = made.layout.projection
    assert isinstance(projection, Spherical)
    np.testing.assert_allclose(projection.azimuth_step, step, rtol=1e-9)
    np.testing.assert_allclose(np.mod(projection.azimuth[0], 2 * np.pi), 2 * np.pi - 3.1)
    np.testing.assert_allclose(made.image(cloud), image, rtol=1e-6)


def test_points_in_no_order_are_projected_onto_the_surface_they_came_from():
    cloud = points(HOLE, wall(HOLE), BODY).reshape(-1, 3)
    cloud = cloud[np.random.default_rng(0).permutation(len(cloud))]
    made = cloud_images(lambda: [cloud[None]], None)
    projection = made.layout.projection
    assert isinstance(projection, Spherical)
    image = made.image(cloud[None])
    away = np.abs(image - wall(projection))
    measured = np.isfinite(image)
    assert measured.mean() > 0.7  # the corners of a pinhole's image lie beyond its edges' middles
    # The points are 3 degrees apart; unmoved to the pixels' middles they would be 20 mm off.
    assert np.median(away[measured]) < 0.0005
    assert made.layout.R_cloud_sensor.tolist() == BODY.tolist()


def test_the_resolution_of_a_projection_can_be_given():
    cloud = points(HOLE, wall(HOLE), OPTICAL)
    made = cloud_images(lambda: [cloud], 5.0)
    projection = made.layout.projection
    assert isinstance(projection, Spherical)
    np.testing.assert_allclose(np.degrees(projection.azimuth_step), 5.0)
    np.testing.assert_allclose(np.degrees(projection.elevation_step), -5.0)


def test_a_projection_sees_all_points_of_all_clouds():
    cloud = points(HOLE, wall(HOLE), OPTICAL)
    left, right = cloud[:, :20], cloud[:, 20:]
    made = cloud_images(lambda: [left, right], 4.0)
    assert isinstance(made.layout.projection, Spherical)
    first, last = made.layout.projection.azimuth
    azimuths = np.arctan2(cloud[..., 0], cloud[..., 2])
    assert first <= azimuths.min() <= azimuths.max() <= last


def test_too_fine_a_projection_is_refused():
    cloud = points(HOLE, wall(HOLE), OPTICAL)
    with pytest.raises(ValueError, match=r"pixels at a resolution of 0.001 degrees; .* --resolut"):
        cloud_images(lambda: [cloud], 0.001)


def imported(tmp_path: Path, m: Messages, message: Any, **more: Any) -> Imported:
    source = write_bag(tmp_path, m, [("/sensor", 0.0, message)])
    (tmp_path / "out").mkdir()
    return import_recording(source, tmp_path / "out", **more)


@pytest.mark.parametrize("kind", KINDS)
def test_a_cloud_of_a_bag_is_an_image(tmp_path: Path, kind: str):
    m = Messages(kind)
    image = wall(SCANNER)
    made = imported(tmp_path, m, m.cloud(m.header(0.0, "lidar"), points(SCANNER, image, BODY)))
    assert any(
        "organised clouds were taken as they are: a spherical image" in n for n in made.notes
    )
    np.testing.assert_allclose(np.load(made.job.parent / "depth" / "0001.npy"), image, rtol=1e-5)
    assert "columns = 60\nrows = 16\n" in made.job.read_text()


@pytest.mark.parametrize("kind", KINDS)
def test_a_scan_is_an_image_of_one_row(tmp_path: Path, kind: str):
    m = Messages(kind)
    ranges = np.array([1.0, 2.0, np.inf, 3.0, 0.05, 5.0])
    made = imported(tmp_path, m, m.scan(m.header(0.0, "laser"), -0.5, 0.3, ranges))
    row = np.load(made.job.parent / "depth" / "0001.npy")
    # ROS counts angles to the left; the first pixel of an image is its leftmost.
    np.testing.assert_array_equal(row, [[5.0, np.nan, 3.0, np.nan, 2.0, 1.0]])
    text = made.job.read_text()
    first, last = numbers_of(text, "azimuth_deg")
    np.testing.assert_allclose(np.radians([first, last]), [-1.0, 0.5], atol=1e-6)
    assert numbers_of(text, "elevation_deg") == [0.0, 0.0]
    np.testing.assert_allclose(numbers_of(text, "range"), [0.1, 30.0], rtol=1e-6)


def test_a_scan_of_the_whole_turn_keeps_each_angle_once(tmp_path: Path):
    m = Messages("mcap")
    made = imported(tmp_path, m, m.scan(m.header(0.0), -math.pi, math.radians(1.0), np.ones(361)))
    assert "columns = 360" in made.job.read_text()


def test_a_scan_is_where_its_points_are():
    ranges = np.array([1.0, 2.0, 3.0])
    m = Messages("mcap")
    message = m.scan(m.header(0.0), -0.2, 0.5, ranges)
    layout = scan_layout(message)
    image = torch.from_numpy(scan_image(message, layout)).double()
    u, v = pixel_grid(layout.projection, dtype=torch.float64, device=torch.device("cpu"))
    found = (image[..., None] * layout.projection.rays(u, v)).numpy()[0] @ BODY.T
    angles = -0.2 + 0.5 * np.arange(3)
    by_hand = np.stack([ranges * np.cos(angles), ranges * np.sin(angles), 0.0 * angles], 1)
    np.testing.assert_allclose(found[::-1], by_hand, atol=1e-6)


def test_a_cloud_without_coordinates_is_a_mistake(tmp_path: Path):
    m = Messages("mcap")
    message = m.cloud(m.header(0.0), points(SCANNER, wall(SCANNER), BODY))
    message = type(message)(**{**vars(message), "fields": message.fields[:2]})
    with pytest.raises(JobError, match=r"/sensor: .* fields x, y; expected x, y and z"):
        imported(tmp_path, m, message)
