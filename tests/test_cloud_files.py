"""PCD files in all three encodings and PLY files become images of what they were made of."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from walls import HOLE, numbers_of, points, wall

from torchcal.errors import JobError
from torchcal.model.recordings.import_recording import import_recording
from torchcal.model.recordings.layout import BODY, OPTICAL
from torchcal.model.recordings.lzf import decode_lzf
from torchcal.model.recordings.recorded import Selection

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
    np.testing.assert_allclose(numbers_of(text, "pose"), [1.0, 2.0, 3.0])
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


def test_a_cloud_that_is_not_there_cannot_be_chosen(tmp_path: Path):
    write_pcd(tmp_path / "a.pcd", points(HOLE, wall(HOLE), OPTICAL), "binary")
    (tmp_path / "out").mkdir()
    with pytest.raises(JobError, match=r"--use: found nosuch; expected one of a\.pcd"):
        import_recording(tmp_path, tmp_path / "out", selection=Selection(use=("nosuch",)))


@pytest.mark.parametrize("view", ["1 2 3 0 0 0 0", "1 2 3 1 0 0", "nan 2 3 1 0 0 0"])
def test_a_viewpoint_that_is_no_pose_is_a_mistake(tmp_path: Path, view: str):
    file = tmp_path / "a.pcd"
    write_pcd(file, points(HOLE, wall(HOLE), OPTICAL), "ascii")
    lines = file.read_text().splitlines()
    lines = [f"VIEWPOINT {view}" if line.startswith("VIEWPOINT") else line for line in lines]
    file.write_text("\n".join(lines))
    with pytest.raises(JobError, match=f"the VIEWPOINT {view}; expected tx ty tz qw"):
        import_recording(file, tmp_path)


@pytest.mark.parametrize("size", ["WIDTH 1000000000000", "WIDTH -4"])
def test_an_absurd_number_of_points_is_a_mistake(tmp_path: Path, size: str):
    file = tmp_path / "a.pcd"
    write_pcd(file, points(HOLE, wall(HOLE), OPTICAL), "binary_compressed")
    head, data = file.read_bytes().split(b"VIEWPOINT", 1)
    width = head.index(b"WIDTH")
    rest = head[head.index(b"\n", width) :]
    file.write_bytes(head[:width] + size.encode() + rest + b"VIEWPOINT" + data)
    with pytest.raises(JobError, match="points; expected WIDTH and HEIGHT"):
        import_recording(file, tmp_path)


@pytest.mark.parametrize("word", ["1e400", "1e300", "1e30"])
@pytest.mark.parametrize("organised", [True, False])
def test_nonsense_among_the_points_is_no_measurement(tmp_path: Path, word: str, organised: bool):
    """Any warning of the numbers' overflow would fail here."""
    image = wall(HOLE)
    cloud = points(HOLE, image, OPTICAL)
    file = tmp_path / "a.pcd"
    write_pcd(file, cloud if organised else cloud.reshape(1, -1, 3), "ascii")
    lines = file.read_text().splitlines()
    lines[-1] = " ".join([word] * 3 + lines[-1].split()[3:])
    file.write_text("\n".join(lines))
    made = import_recording(file, tmp_path)
    read = np.load(tmp_path / "depth/0001.npy")
    assert made.frames == 1
    assert np.nanmax(read) < 4.0
    assert np.isnan(read).any()
