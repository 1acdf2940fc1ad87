"""Folders of depth images with Open3D's intrinsics and a trajectory of one of three forms."""

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from torchcal.errors import JobError
from torchcal.geometry import se3
from torchcal.model.recordings.import_recording import Imported, import_recording
from torchcal.model.recordings.recorded import Selection

TIMES = ("1305031102.160407", "1305031102.194330", "1305031102.226738")
INTRINSICS = {
    "width": 8,
    "height": 6,
    "intrinsic_matrix": [9.0, 0.0, 0.0, 0.0, 9.5, 0.0, 3.5, 2.5, 1.0],
}


def poses() -> torch.Tensor:
    """T_world_camera of three images."""
    xi = torch.tensor([[0.1 * k, 0.2, -0.3, 0.2, 0.1 * k, -0.4] for k in range(3)])
    return se3.exp(xi.double())


def write_images(folder: Path, names: tuple[str, ...] = TIMES) -> Path:
    (folder / "depth").mkdir(parents=True)
    for k, name in enumerate(names):
        image = np.full((6, 8), 1000 + k, np.uint16)
        Image.fromarray(image).save(folder / "depth" / f"{name}.png")
    (folder / "camera.json").write_text(json.dumps(INTRINSICS))
    return folder


def write_log(file: Path) -> None:
    rows = [
        f"{k} {k} {k + 1}\n" + "\n".join(" ".join(f"{x:.17g}" for x in row) for row in T.tolist())
        for k, T in enumerate(poses())
    ]
    file.write_text("\n".join(rows) + "\n")


def write_tum(file: Path) -> None:
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    for time, T in zip(TIMES, poses(), strict=True):
        # The quaternion of a rotation by its trace, scalar last.
        w = 0.5 * torch.sqrt(1.0 + T[0, 0] + T[1, 1] + T[2, 2])
        x, y, z = ((T[i, j] - T[j, i]) / (4.0 * w) for i, j in ((2, 1), (0, 2), (1, 0)))
        numbers = [*T[:3, 3].tolist(), float(x), float(y), float(z), float(w)]
        rows.append(f"{float(time) + 0.01:.6f} " + " ".join(f"{each:.17g}" for each in numbers))
        rows.append(f"{float(time) + 0.017:.6f} 9 9 9 0 0 0 1")
    file.write_text("\n".join(rows))


def write_json(file: Path) -> None:
    parameters = [
        {"extrinsic": torch.linalg.inv(T).mT.flatten().tolist(), "intrinsic": INTRINSICS}
        for T in poses()
    ]
    file.write_text(json.dumps({"class_name": "x", "parameters": parameters}))


def imported(source: Path, tmp_path: Path, **more) -> Imported:
    (tmp_path / "out").mkdir()
    return import_recording(source, tmp_path / "out", **more)


def poses_of(made: Imported) -> torch.Tensor:
    tables = [frame["pose"] for frame in tomllib.loads(made.job.read_text())["frame"]]
    xyz = torch.tensor([each["xyz"] for each in tables], dtype=torch.float64)
    rpy = torch.tensor([each["rpy_deg"] for each in tables], dtype=torch.float64)
    return se3.from_xyz_rpy(xyz, rpy.deg2rad())


@pytest.mark.parametrize(
    ("name", "write"),
    [
        ("trajectory.log", write_log),
        ("groundtruth.txt", write_tum),
        ("trajectory.json", write_json),
    ],
)
def test_poses_come_from_any_of_three_files(tmp_path: Path, name: str, write):
    source = write_images(tmp_path / "in")
    write(source / name)
    made = imported(source, tmp_path)
    torch.testing.assert_close(poses_of(made), poses(), rtol=0, atol=1e-9)
    assert list(made.to_fill_in) == ["world"]


def test_intrinsics_and_images_are_those_of_the_folder(tmp_path: Path):
    made = imported(write_images(tmp_path / "in"), tmp_path, selection=Selection(depth_unit=0.0002))
    sensor = tomllib.loads(made.job.read_text())["sensor"]
    assert [sensor[key] for key in ("width", "height", "fx", "fy", "cx", "cy")] == [
        8,
        6,
        9.0,
        9.5,
        3.5,
        2.5,
    ]
    assert sensor["depth_unit"] == 0.0002
    np.testing.assert_array_equal(np.asarray(Image.open(tmp_path / "out/depth/0002.png")), 1001)


def test_frames_are_taken_at_equal_steps(tmp_path: Path):
    source = write_images(tmp_path / "in")
    write_log(source / "trajectory.log")
    made = imported(source, tmp_path, selection=Selection(frames=2))
    torch.testing.assert_close(poses_of(made), poses()[::2], rtol=0, atol=1e-9)


def test_a_pose_that_is_not_that_of_an_image_is_not_taken(tmp_path: Path):
    source = write_images(tmp_path / "in", (*TIMES[:2], "1305031109.5"))
    write_tum(source / "groundtruth.txt")
    assert imported(source, tmp_path).frames == 2


def test_without_a_trajectory_the_poses_are_to_be_filled_in(tmp_path: Path):
    made = imported(write_images(tmp_path / "in"), tmp_path)
    assert set(made.to_fill_in) == {"world", "frame.pose"}


def test_a_trajectory_of_another_length_is_a_mistake(tmp_path: Path):
    source = write_images(tmp_path / "in", TIMES[:2])
    write_log(source / "trajectory.log")
    with pytest.raises(JobError, match="3 poses and 2 images; expected one pose for each image"):
        imported(source, tmp_path)


def test_of_several_trajectories_a_person_has_to_choose(tmp_path: Path):
    source = write_images(tmp_path / "in")
    for name in ("odometry.log", "slam.log"):
        write_log(source / name)
    with pytest.raises(
        JobError, match=r"2 files with poses: odometry.log, slam.log; .* --use FILE"
    ):
        imported(source, tmp_path)
    # Eight numbers that are no pose do not matter once the poses are chosen.
    (source / "imu.txt").write_text("1.0 0 0 9.8 0.1 0.2 0.3 25.0\n")
    made = import_recording(source, tmp_path / "out", selection=Selection(use=("slam.log",)))
    assert made.frames == 3


def test_a_matrix_that_is_no_motion_is_a_mistake(tmp_path: Path):
    source = write_images(tmp_path / "in")
    mirrored = [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    text = "0 0 1\n" + "\n".join(" ".join(map(str, row)) for row in mirrored)
    (source / "trajectory.log").write_text(text)
    with pytest.raises(JobError, match=r"pose\[1\]: found a matrix that is no rigid motion"):
        imported(source, tmp_path)


def tum(*rows: str) -> str:
    sound = [f"{time} 0 0 0 0 0 0 1" for time in TIMES]
    return "\n".join([*sound[: 3 - len(rows)], *rows])


BROKEN_POSES = [
    ("groundtruth.txt", tum("3.0 1 2 3 0 0 0 0"), r"line 3: found a quaternion of length 0"),
    ("slam.txt", tum("3.0 1 2 3 0 0 0"), "line 3: found 7 words; expected time, x, y, z, qx"),
    ("slam.txt", tum("3.0 nan 2 3 0 0 0 1"), 'line 3: found "nan"; expected finite numbers'),
    ("trajectory.log", "0 0 1\n1 0 0 0\n0 1 0\n", "line 3: found 3 words"),
    ("slam.log", "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0", "line 4: found the end within a pose"),
    ("slam.log", "0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 1 1", "matrix that is no rigid"),
    ("camera_poses.txt", "1 0 0 0 0 1 0 0 0 0 1 0", "found no poses that can be read"),
    ("poses.txt", "", "found no poses that can be read"),
    ("a.json", '{"parameters": [{"extrinsic": [1, 2]}]}', r"\[0\].extrinsic: found \[1, 2\]"),
    ("a.json", json.dumps({"parameters": [{"extrinsic": ["x"] * 16}]}), "expected a list of 16"),
]


@pytest.mark.parametrize(("name", "text", "message"), BROKEN_POSES)
def test_broken_poses_are_no_missing_poses(tmp_path: Path, name: str, text: str, message: str):
    source = write_images(tmp_path / "in")
    (source / name).write_text(text)
    with pytest.raises(JobError, match=message):
        imported(source, tmp_path)


def test_other_texts_in_the_folder_are_no_poses(tmp_path: Path):
    source = write_images(tmp_path / "in")
    (source / "rgb.txt").write_text("# a list\n1.5 rgb/1.png\n")
    (source / "driver.log").write_text("started\n1 2 3\n")
    assert "frame.pose" in imported(source, tmp_path).to_fill_in


def test_a_file_that_is_not_there_cannot_be_chosen(tmp_path: Path):
    source = write_images(tmp_path / "in")
    write_log(source / "slam.log")
    with pytest.raises(JobError, match=r"--use: found nosuch; expected one of camera.json, slam"):
        imported(source, tmp_path, selection=Selection(use=("nosuch",)))


ABSURD = [
    ({"width": 1e400}, "a width of inf; expected whole pixels"),
    ({"height": 6.5}, "a height of 6.5; expected whole pixels"),
    ({"fx": -9.0}, "fx = -9; expected a focal length above 0"),
    ({"fy": 0.0}, "fy = 0; expected a focal length above 0"),
    ({"fx": float("nan")}, "fx = nan"),
    ({"cx": float("inf")}, "cx = inf; expected the image's centre"),
    ({"cy": 1e9}, r"cy = 1e\+09; expected the image's centre"),
]


def intrinsics(changed: dict[str, float]) -> str:
    places = {"fx": 0, "fy": 4, "cx": 6, "cy": 7}
    matrix = [*INTRINSICS["intrinsic_matrix"]]
    for key, value in changed.items():
        if key in places:
            matrix[places[key]] = value
    sizes = {key: value for key, value in changed.items() if key not in places}
    return json.dumps({**INTRINSICS, "intrinsic_matrix": matrix, **sizes})


@pytest.mark.parametrize(("changed", "message"), ABSURD)
def test_absurd_intrinsics_are_a_mistake(tmp_path: Path, changed: dict, message: str):
    source = write_images(tmp_path / "in")
    (source / "camera.json").write_text(intrinsics(changed).replace("Infinity", "1e400"))
    with pytest.raises(JobError, match=rf"camera.json: found intrinsics .*{message}"):
        imported(source, tmp_path)


def test_an_optical_axis_outside_the_image_is_told(tmp_path: Path):
    source = write_images(tmp_path / "in")
    (source / "camera.json").write_text(intrinsics({"cx": 20.0}))
    notes = imported(source, tmp_path).notes
    assert any(note.startswith("WARNING: the optical axis meets") for note in notes)


def test_images_without_a_measurement_are_blamed_on_the_source(tmp_path: Path):
    source = write_images(tmp_path / "in")
    for file in (source / "depth").iterdir():
        Image.fromarray(np.zeros((6, 8), np.uint16)).save(file)
    with pytest.raises(JobError, match="nothing was measured") as caught:
        imported(source, tmp_path)
    assert caught.value.file == source


def test_images_without_intrinsics_say_what_is_missing(tmp_path: Path):
    source = write_images(tmp_path / "in")
    (source / "camera.json").unlink()
    with pytest.raises(JobError, match="no file with camera intrinsics; expected a JSON file with"):
        imported(source, tmp_path)


def test_broken_intrinsics_are_a_mistake(tmp_path: Path):
    source = write_images(tmp_path / "in")
    (source / "camera.json").write_text('{"intrinsic_matrix": [1, 2]}')
    with pytest.raises(JobError, match=r"camera.json: found intrinsics that cannot be used"):
        imported(source, tmp_path)


def test_images_of_another_size_are_a_mistake(tmp_path: Path):
    source = write_images(tmp_path / "in")
    (source / "camera.json").write_text(json.dumps({**INTRINSICS, "width": 9}))
    with pytest.raises(JobError, match="8x6 pixels; expected 9x6, as its intrinsics say"):
        imported(source, tmp_path)


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\nxx"])
def test_a_broken_image_is_a_mistake(tmp_path: Path, content: bytes):
    source = write_images(tmp_path / "in")
    (source / "depth" / f"{TIMES[0]}.png").write_bytes(content)
    with pytest.raises(JobError, match=r"\.png: found an image that cannot be read"):
        imported(source, tmp_path)


def test_colour_images_are_no_depth(tmp_path: Path):
    source = write_images(tmp_path / "in")
    Image.new("RGB", (8, 6)).save(source / "depth" / f"{TIMES[0]}.png")
    with pytest.raises(JobError, match=r"uint8 and shape \(6, 8, 3\); expected one channel of 16"):
        imported(source, tmp_path)


def test_a_folder_with_nothing_to_import_says_what_can_be(tmp_path: Path):
    with pytest.raises(JobError, match=r"nothing that can be imported; expected a bag of ROS 1"):
        import_recording(tmp_path, tmp_path)
    with pytest.raises(JobError, match="no such file or folder; expected a bag"):
        import_recording(tmp_path / "none.bag", tmp_path)


def test_a_real_folder_of_open3d_becomes_a_job(tmp_path: Path, shared: Path):
    made = import_recording(shared / "data/open3d_rgbd", tmp_path)
    tables = tomllib.loads(made.job.read_text())
    assert made.frames == len(tables["frame"]) == 5
    assert tables["sensor"]["fx"] == 525.0
    first = torch.tensor([-0.31057997014702826, 0.5730122438481298, 2.1264800183565487]).double()
    torch.testing.assert_close(poses_of(made)[0, :3, 3], first, rtol=0, atol=1e-7)
    assert poses_of(made)[0, 2, 0] == pytest.approx(-0.9617413095492113, abs=1e-6)
