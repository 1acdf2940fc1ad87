"""Scans and clouds: the same range images come back that the points were made of."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from bags import KINDS, Messages, write_bag

from torchcal.errors import JobError
from torchcal.geometry.projection import Pinhole, Projection, Spherical, pixel_grid
from torchcal.model.recordings.cloud_images import cloud_images
from torchcal.model.recordings.import_recording import Imported, import_recording
from torchcal.model.recordings.layout import BODY, OPTICAL
from torchcal.model.recordings.lzf import decode_lzf
from torchcal.model.recordings.recorded import Selection
from torchcal.model.recordings.scans import scan_image, scan_layout

HOLE = Pinhole(width=40, height=30, fx=35.0, fy=36.0, cx=20.25, cy=14.5)
SCANNER = Spherical(width=60, height=16, azimuth=(-0.9, 0.8), elevation=(0.3, -0.2))


def wall(projection: Projection, tilt: float = 0.3) -> np.ndarray:
    """What a sensor 2 m before an oblique wall measures (m)."""
    u, v = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    normal = torch.tensor([math.sin(tilt), 0.1, math.cos(tilt)], dtype=torch.float64)
    return (2.0 / (projection.rays(u, v) @ normal)).numpy()


def points(projection: Projection, image: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The same as points in the frame of a cloud, ``(h w 3)``."""
    u, v = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    return (torch.from_numpy(image)[..., None] * projection.rays(u, v)).numpy() @ axes.T


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
    first, last = eval_list(text, "azimuth_deg")
    np.testing.assert_allclose(np.radians([first, last]), [-1.0, 0.5], atol=1e-6)
    assert eval_list(text, "elevation_deg") == [0.0, 0.0]
    np.testing.assert_allclose(eval_list(text, "range"), [0.1, 30.0], rtol=1e-6)


def eval_list(text: str, key: str) -> list[float]:
    line = next(line for line in text.splitlines() if line.startswith(f"{key} = "))
    return [float(word) for word in line.split("[")[1].split("]")[0].split(",")]


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


HEADER = """\
# .PCD v0.7 - Point Cloud Data file format
VERSION 0.7
FIELDS x y z _ intensity
SIZE 4 4 4 1 4
TYPE F F F U F
COUNT 1 1 1 4 1
WIDTH {width}
HEIGHT {height}
VIEWPOINT 1 2 3 0.7071067811865476 0 0 0.7071067811865476
POINTS {points}
DATA {data}
"""


def write_pcd(file: Path, cloud: np.ndarray, data: str) -> None:
    kind = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("_", "u1", (4,)), ("i", "<f4")])
    height, width = cloud.shape[:2]
    records = np.zeros(height * width, kind)
    for k, name in enumerate("xyz"):
        records[name] = cloud[..., k].ravel()
    head = HEADER.format(width=width, height=height, points=height * width, data=data).encode()
    if data == "ascii":
        rows = [
            "{x} {y} {z} 0 0 0 0 0.5".format(**dict(zip("xyz", p, strict=True)))
            for p in cloud.reshape(-1, 3)
        ]
        file.write_bytes(head + "\n".join(rows).encode())
    elif data == "binary":
        file.write_bytes(head + records.tobytes())
    else:
        columns = b"".join(
            np.ascontiguousarray(records[name]).tobytes() for name in kind.names or ()
        )
        packed = lzf(columns)
        sizes = np.array([len(packed), len(columns)], "<u4").tobytes()
        file.write_bytes(head + sizes + packed)


def lzf(data: bytes) -> bytes:
    """Runs of bytes, and a copy where the last ten bytes come again."""
    out, at, run = bytearray(), 0, bytearray()

    def flush() -> None:
        for k in range(0, len(run), 32):
            out.extend([len(run[k : k + 32]) - 1, *run[k : k + 32]])
        run.clear()

    while at < len(data):
        before = data.rfind(data[at : at + 10], max(0, at - 4000), at)
        if before >= 0 and at + 10 <= len(data):
            flush()
            away = at - before - 1
            out.extend([(7 << 5) | (away >> 8), 10 - 2 - 7, away & 255])
            at += 10
        else:
            run.append(data[at])
            at += 1
    flush()
    return bytes(out)


@pytest.mark.parametrize("data", ["ascii", "binary", "binary_compressed"])
def test_a_pcd_file_is_an_image_from_its_viewpoint(tmp_path: Path, data: str):
    image = wall(HOLE)
    write_pcd(tmp_path / "cloud.pcd", points(HOLE, image, OPTICAL), data)
    (tmp_path / "out").mkdir()
    made = import_recording(tmp_path / "cloud.pcd", tmp_path / "out")
    np.testing.assert_allclose(np.load(tmp_path / "out/depth/0001.npy"), image, rtol=1e-5)
    text = made.job.read_text()
    np.testing.assert_allclose(eval_list(text, "pose"), [1.0, 2.0, 3.0])
    assert "rpy_deg = [0.0, 0.0, 90.0" in text or "rpy_deg = [0.0, -0.0, 90.0" in text
    assert "frame.pose" not in made.to_fill_in


def test_overlapping_copies_repeat_what_they_copy():
    # One byte, then a copy of seven from one byte back.
    assert decode_lzf(bytes([0, 65, (5 << 5), 0]), 8) == b"A" * 8
    with pytest.raises(ValueError, match="8 bytes after decompression; expected 9"):
        decode_lzf(bytes([0, 65, (5 << 5), 0]), 9)


def test_ply_points_of_the_world_are_seen_from_where_the_sensor_stood(tmp_path: Path):
    seen = points(HOLE, wall(HOLE), BODY).reshape(-1, 3)
    position = np.array([4.0, -1.0, 0.5])
    trimesh.PointCloud(seen + position).export(tmp_path / "cloud.ply")
    (tmp_path / "out").mkdir()
    selection = Selection(position=(4.0, -1.0, 0.5))
    made = import_recording(tmp_path / "cloud.ply", tmp_path / "out", selection=selection)
    assert "xyz = [4.0, -1.0, 0.5]" in made.job.read_text()
    image = np.load(tmp_path / "out/depth/0001.npy")
    ranges = np.linalg.norm(seen, axis=1)
    assert ranges.min() * 0.99 < np.nanmin(image) < np.nanmax(image) < ranges.max() * 1.01


def test_ply_points_without_a_position_leave_it_to_be_filled_in(tmp_path: Path):
    trimesh.PointCloud(points(HOLE, wall(HOLE), BODY).reshape(-1, 3)).export(tmp_path / "a.ply")
    (tmp_path / "out").mkdir()
    assert "frame.pose" in import_recording(tmp_path, tmp_path / "out").to_fill_in


@pytest.mark.parametrize("cut", [60, 400])
def test_a_truncated_pcd_file_is_one_clear_error(tmp_path: Path, cut: int):
    file = tmp_path / "cloud.pcd"
    write_pcd(file, points(HOLE, wall(HOLE), OPTICAL), "binary")
    file.write_bytes(file.read_bytes()[:cut])
    with pytest.raises(JobError, match=r"cloud\.pcd: found a cloud that cannot be read"):
        import_recording(file, tmp_path)


def test_a_real_cloud_without_an_order_becomes_an_image(tmp_path: Path, shared: Path):
    made = import_recording(
        shared / "data/reghec_jaka/Cylinder", tmp_path, selection=Selection(frames=2)
    )
    image = np.load(tmp_path / "depth/0001.npy")
    assert made.frames == 2
    # The cloud's own note: 0.25 to 0.37 m; a cut-out object fills half of the rectangle.
    assert 0.25 < np.nanmin(image) < np.nanmax(image) < 0.4
    assert np.isfinite(image).mean() > 0.4
