"""Bags of all three kinds, written and read back: images, joints, mount and what is said of them."""

import sys
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_job
import torch
from bags import KINDS, Messages, write_bag

from torchcal.errors import JobError, TorchcalError
from torchcal.geometry.projection import Pinhole
from torchcal.model.read_job import read_job
from torchcal.model.recordings.import_recording import Imported, import_recording
from torchcal.model.recordings.recorded import Selection

WIDTH, HEIGHT = 8, 6
MATRIX = (9.0, 0.0, 3.5, 0.0, 9.5, 2.5, 0.0, 0.0, 1.0)
DEPTH, INFO, JOINTS = "/camera/depth/image_rect_raw", "/camera/depth/camera_info", "/joint_states"
FRAME = "depth_optical_frame"
POSTURES = (0.1, 0.1, -0.4, 0.7)
"""Of the shoulder (rad), two seconds each; the first two are one."""
SWING = 0.4
"""s from one posture to the next."""


def depth(k: int) -> np.ndarray:
    """An image that tells its number: mm."""
    image = np.full((HEIGHT, WIDTH), 1000 + k, np.uint16)
    image[0, 0] = 0
    return image


def shoulder(time: float) -> float:
    """rad: the posture of these two seconds, to which it swings at their beginning."""
    k = min(int(time // 2.0), len(POSTURES) - 1)
    before = POSTURES[max(k - 1, 0)]
    share = min((time - 2.0 * k) / SWING, 1.0)
    return before + share * (POSTURES[k] - before)


def arm(messages: Messages, *, without: tuple[str, ...] = (), clock: float = 0.0) -> list:
    """An arm with a camera on its tool, recorded for eight seconds."""
    m = messages
    flange = m.transform(m.header(0.0, "tool"), "camera_link", (0.0, 0.0, 0.1))
    lens = m.transform(
        m.header(0.0, "camera_link"), FRAME, (0.02, 0.0, 0.0), (-0.5, 0.5, -0.5, 0.5)
    )
    content: list[tuple[str, float, Any]] = [
        ("/robot_description", 0.0, m.text(tiny_job.urdf())),
        ("/tf_static", 0.0, m.transforms(flange, lens)),
        (INFO, 0.0, m.camera(m.header(0.0, FRAME), (WIDTH, HEIGHT), MATRIX)),
    ]
    for k in range(80):
        time = 0.1 * k
        names = {"shoulder": shoulder(time), "elbow": -0.2}
        content.append((JOINTS, time + 0.001, m.joints(m.header(time), names)))
    for k in range(16):
        time = 0.5 * k + 0.03
        image = m.image(m.header(time, FRAME, clock), depth(k), "16UC1")
        content.append((DEPTH, time + 0.02, image))
    return [each for each in content if each[0] not in without]


def imported(tmp_path: Path, content: list, messages: Messages, **more: Any) -> Imported:
    source = write_bag(tmp_path, messages, content)
    (tmp_path / "out").mkdir()
    return import_recording(source, tmp_path / "out", **more)


@pytest.mark.parametrize("kind", KINDS)
def test_an_arms_bag_becomes_a_job(tmp_path: Path, kind: str):
    m = Messages(kind)
    made = imported(tmp_path, arm(m), m)
    job = read_job(made.job)
    assert job.sensor.projection == Pinhole(width=8, height=6, fx=9.0, fy=9.5, cx=3.5, cy=2.5)
    assert job.robot is not None
    assert job.link == "tool"
    assert made.frames == len(job.frames) == 3
    by_hand = torch.tensor(
        [[0, 0, 1, 0.02], [-1, 0, 0, 0], [0, -1, 0, 0.1], [0, 0, 0, 1]], dtype=torch.float64
    )
    torch.testing.assert_close(job.T_link_sensor, by_hand)
    joints = torch.stack([frame.joints for frame in job.frames if frame.joints is not None])
    assert job.robot.joint_names == ("shoulder", "elbow", "lift")
    wanted = [[posture, -0.2, 0.0] for posture in POSTURES[1:]]
    torch.testing.assert_close(joints, torch.tensor(wanted, dtype=torch.float64))


@pytest.mark.parametrize("kind", KINDS)
def test_images_are_those_of_the_middle_of_each_posture(tmp_path: Path, kind: str):
    m = Messages(kind)
    job = read_job(imported(tmp_path, arm(m), m).job)
    numbers = [float(frame.image.range[3, 3]) * 1000.0 - 1000.0 for frame in job.frames]
    # Images come twice a second; the first two postures, four seconds from 0, are one.
    np.testing.assert_allclose(numbers, [4, 10, 14], atol=1.0)
    assert all(bool(frame.image.range[0, 0].isnan()) for frame in job.frames)


def test_the_pairing_is_reported(tmp_path: Path):
    m = Messages("mcap")
    notes = imported(tmp_path, arm(m), m).notes
    # Joints at whole tenths of a second, images 30 ms later.
    assert any("-30.0 ms (median) and at most 30.0 ms" in note for note in notes)
    assert any("WARNING: no values of the joints lift" in note for note in notes)


def test_few_frames_are_of_postures_that_differ_most(tmp_path: Path):
    m = Messages("mcap")
    job = read_job(imported(tmp_path, arm(m), m, selection=Selection(frames=2)).job)
    # The first one and, of 0.1, -0.4 and 0.7 rad, the farthest from it.
    assert [round(float(f.joints[0]), 6) for f in job.frames if f.joints is not None] == [0.1, 0.7]


def test_clocks_that_differ_are_told_and_the_recorders_is_taken(tmp_path: Path):
    m = Messages("sqlite3")
    made = imported(tmp_path, arm(m, clock=-3600.0), m)
    assert any("clocks of" in note and "differ by 3.6e+03 s" in note for note in made.notes)
    assert made.frames == 3


def test_clocks_that_nearly_agree_are_those_of_the_senders(tmp_path: Path):
    m = Messages("sqlite3")
    made = imported(tmp_path, arm(m, clock=0.2), m)
    assert not any("clocks of" in note for note in made.notes)
    assert any("at most 30.0 ms" in note for note in made.notes)


def test_joints_and_images_of_different_times_are_a_mistake(tmp_path: Path):
    m = Messages("mcap")
    late = [(JOINTS, 100.0 + k, m.joints(m.header(100.0 + k), {"shoulder": 0.1})) for k in range(3)]
    late += arm(m, without=(JOINTS,))
    with pytest.raises(JobError, match=r"no image within 0.5 s of joints .* 92\.\d s away"):
        imported(tmp_path, late, m)


def test_a_bag_without_joints_says_which_it_lacks(tmp_path: Path):
    m = Messages("mcap")
    with pytest.raises(JobError, match=r"no sensor_msgs/JointState; expected .* shoulder, elbow"):
        imported(tmp_path, arm(m, without=(JOINTS,)), m)


def test_a_bag_without_images_lists_what_it_has(tmp_path: Path):
    m = Messages("ros1")
    with pytest.raises(JobError, match=r"/camera/depth/camera_info, /joint_states.*16UC1"):
        imported(tmp_path, arm(m, without=(DEPTH,)), m)


def test_of_several_depth_topics_the_one_with_a_camera_is_taken(tmp_path: Path):
    m = Messages("mcap")
    other = ("/other/depth", 0.1, m.image(m.header(0.1, "other"), depth(0), "16UC1"))
    assert imported(tmp_path, [*arm(m), other], m).frames == 3


def two_cameras(m: Messages) -> list:
    image = m.image(m.header(0.53, FRAME), depth(700), "16UC1")
    info = m.camera(m.header(0.0, FRAME), (WIDTH, HEIGHT), MATRIX)
    return [*arm(m), ("/left/depth", 0.53, image), ("/left/camera_info", 0.0, info)]


def test_of_several_cameras_a_person_has_to_choose(tmp_path: Path):
    m = Messages("mcap")
    expected = r"2 topics .*: /camera/depth/image_rect_raw, /left/depth; expected --use TOPIC"
    with pytest.raises(JobError, match=expected):
        imported(tmp_path, two_cameras(m), m)


def test_the_chosen_topic_is_read(tmp_path: Path):
    m = Messages("mcap")
    made = imported(tmp_path, two_cameras(m), m, selection=Selection(use=("/left/depth",)))
    assert float(read_job(made.job).frames[0].image.range[3, 3]) == 1.7


def test_a_topic_that_is_not_there_is_answered_with_those_that_are(tmp_path: Path):
    m = Messages("mcap")
    with pytest.raises(JobError, match=r"/depth: found no such topic; expected one of /camera"):
        imported(tmp_path, arm(m), m, selection=Selection(use=("/depth",)))


@pytest.mark.parametrize("kind", KINDS)
def test_a_truncated_bag_is_one_clear_error(tmp_path: Path, kind: str):
    m = Messages(kind)
    source = write_bag(tmp_path, m, arm(m))
    file = source if source.is_file() else next(f for f in source.glob("*") if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    with pytest.raises(JobError, match=r"a recording that cannot be read .* whole bag of ROS 1"):
        import_recording(source, tmp_path)


def test_without_the_library_the_error_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    m = Messages("ros1")
    source = write_bag(tmp_path, m, arm(m))
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(TorchcalError, match=r'pip install "torchcal\[bags\]"'):
        import_recording(source, tmp_path)


def test_a_sensor_that_hangs_on_no_link_asks_for_it(tmp_path: Path):
    m = Messages("mcap")
    content = arm(m, without=("/tf_static",))
    with pytest.raises(JobError, match=r"'depth_optical_frame', .* expected --link: one of .*tool"):
        imported(tmp_path, content, m)


def test_a_link_that_the_bag_does_not_connect_leaves_the_mount_to_be_filled_in(tmp_path: Path):
    m = Messages("mcap")
    content = arm(m, without=("/tf_static",))
    made = imported(tmp_path, content, m, selection=Selection(link="tool"))
    assert "sensor.mount" in made.to_fill_in
    assert "# FILL IN: where the sensor is on tool" in made.job.read_text()
    assert read_job(made.job).link == "tool"


def test_a_transform_that_is_sent_again_and_again_is_a_mount(tmp_path: Path):
    m = Messages("ros1")
    flange = m.transform(m.header(0.0, "/tool"), "/" + FRAME, (0.0, 0.0, 0.1))
    sent = [("/tf", 0.1 * k, m.transforms(flange)) for k in range(3)]
    made = imported(tmp_path, [*arm(m, without=("/tf_static",)), *sent], m)
    job = read_job(made.job)
    assert (job.link, float(job.T_link_sensor[2, 3])) == ("tool", 0.1)


def test_a_camera_beside_the_robot_is_carried_by_the_world(tmp_path: Path):
    m = Messages("mcap")
    base = m.transform(m.header(0.0, "world"), "foot", (0.0, 0.0, 0.5))
    camera = m.transform(m.header(0.0, "world"), FRAME, (2.0, 0.0, 1.0))
    static = ("/tf_static", 0.0, m.transforms(base, camera))
    job = read_job(imported(tmp_path, [*arm(m, without=("/tf_static",)), static], m).job)
    assert job.link == "world"
    assert job.T_link_sensor[:3, 3].tolist() == [2.0, 0.0, 1.0]
    assert job.T_world_base[:3, 3].tolist() == [0.0, 0.0, 0.5]


def test_without_a_robot_poses_are_those_of_tf(tmp_path: Path):
    m = Messages("mcap")
    content = arm(m, without=("/robot_description", JOINTS))
    for k in range(80):
        at = m.header(0.1 * k, "map")
        moved = m.transform(at, "tool", (10.0 * shoulder(0.1 * k), 0.0, 0.0))
        content.append(("/tf", 0.1 * k, m.transforms(moved)))
    made = imported(tmp_path, content, m)
    tables = tomllib.loads(made.job.read_text())
    assert "robot" not in tables
    places = [frame["pose"]["xyz"] for frame in tables["frame"]]
    np.testing.assert_allclose(places, [[1.02, 0, 0.1], [-3.98, 0, 0.1], [7.02, 0, 0.1]])
    assert tables["frame"][0]["pose"]["rpy_deg"] == [-90.0, 0.0, -90.0]


def test_without_robot_and_transforms_the_poses_are_to_be_filled_in(tmp_path: Path):
    m = Messages("mcap")
    gone = ("/robot_description", JOINTS, "/tf_static")
    made = imported(tmp_path, arm(m, without=gone), m, selection=Selection(frames=4))
    assert made.frames == 4
    assert made.to_fill_in["frame.pose"] == "where the sensor was: the bag does not say"


def test_a_robot_that_never_stands_still_is_told(tmp_path: Path):
    m = Messages("mcap")
    moving = [
        (JOINTS, 0.1 * k, m.joints(m.header(0.1 * k), {"shoulder": 0.01 * k})) for k in range(80)
    ]
    made = imported(tmp_path, [*arm(m, without=(JOINTS,)), *moving], m)
    assert made.notes[0].startswith("WARNING: the joints never stood still")


def test_a_robot_that_never_moves_is_told(tmp_path: Path):
    m = Messages("mcap")
    still = [(JOINTS, 0.1 * k, m.joints(m.header(0.1 * k), {"shoulder": 0.3})) for k in range(80)]
    made = imported(tmp_path, [*arm(m, without=(JOINTS,)), *still], m)
    assert "WARNING: the joints never moved" in made.notes
    assert made.frames == 1
