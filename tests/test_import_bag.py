"""Bags of all three kinds, written and read back: images, joints, mounts and poses."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import torch
from arm_bag import (
    FRAME,
    JOINTS,
    POSTURES,
    arm,
    imported,
    shoulder,
)
from bags import KINDS, Messages, write_bag

from torchcal.geometry.projection import Pinhole
from torchcal.model.read_job import read_job
from torchcal.model.recordings.import_recording import import_recording
from torchcal.model.recordings.recorded import Selection


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


def test_joints_that_were_asked_for_are_not_those_that_were_measured(tmp_path: Path):
    m = Messages("mcap")
    asked = [
        (
            "/joint_states_desired",
            0.1 * k,
            m.joints(m.header(0.1 * k), {"shoulder": 9.0, "lift": 2.0}),
        )
        for k in range(80)
    ]
    job = read_job(imported(tmp_path, [*arm(m), *asked], m).job)
    joints = [frame.joints.tolist() for frame in job.frames if frame.joints is not None]
    np.testing.assert_allclose(joints, [[each, -0.2, 2.0] for each in POSTURES[1:]])


@pytest.mark.parametrize(("kind", "suffix"), [("mcap", ".mcap"), ("sqlite3", ".db3")])
def test_a_bare_file_of_ros_2_is_a_bag(tmp_path: Path, kind: str, suffix: str):
    m = Messages(kind)
    folder = write_bag(tmp_path, m, arm(m))
    (file,) = folder.glob(f"*{suffix}")
    bare = file.rename(tmp_path / f"bare{suffix}")
    (tmp_path / "out").mkdir()
    assert import_recording(bare, tmp_path / "out").frames == 3


def test_parts_of_a_bag_of_ros_1_are_one_recording(tmp_path: Path):
    m, parts = Messages("ros1"), tmp_path / "parts"
    parts.mkdir()
    for k, keep in enumerate((lambda time: time < 4.0, lambda time: time >= 4.0)):
        path = write_bag(tmp_path, m, [each for each in arm(m) if keep(each[1])])
        path.rename(parts / f"{k}.bag")
    (tmp_path / "out").mkdir()
    assert import_recording(parts, tmp_path / "out").frames == 3
