import math
from pathlib import Path

import numpy as np
import pytest
import tiny_job
import torch
from PIL import Image
from torch.testing import assert_close

from torchcal.errors import JobError
from torchcal.geometry.projection import Pinhole, Spherical
from torchcal.model.read_job import read_job

SHARED = Path(__file__).parents[2] / "shared"


@pytest.fixture
def arm_job(tmp_path):
    return read_job(tiny_job.write(tmp_path, tiny_job.ARM_JOB))


def test_sensor_is_read_as_written(arm_job):
    assert arm_job.sensor.projection == Pinhole(width=8, height=6, fx=9.0, fy=9.5, cx=3.5, cy=2.5)
    assert (arm_job.sensor.near, arm_job.sensor.far) == (0.3, 4.0)
    assert (arm_job.sensor.noise.a, arm_job.sensor.noise.b, arm_job.sensor.noise.c) == (0.01, 0, 0)
    assert arm_job.sensor.noise.drift is None
    assert arm_job.sensor.beam == 1
    assert arm_job.alpha == 3.0


def test_poses_are_in_metres_and_radians(arm_job):
    quarter_turn = [[0.0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    assert_close(arm_job.T_world_base, torch.tensor(quarter_turn, dtype=torch.float64))
    mount = torch.eye(4, dtype=torch.float64)
    mount[2, 3] = 0.1
    assert_close(arm_job.T_link_sensor, mount)


def test_one_sigma_holds_for_all_axes_and_degrees_become_radians(arm_job):
    expected = [0.1, 0.1, 0.1, math.pi, math.pi / 2, 0.0]
    assert_close(arm_job.base.sigma, torch.tensor(expected, dtype=torch.float64))
    assert arm_job.mount is None


def test_every_block_of_unknowns_is_read(tmp_path):
    blocks = """
[unknown.joints]
sigma_deg = 1.0
sigma = 0.02
[unknown.object.crate]
position_sigma = 0.05
rotation_sigma_deg = [0, 0, 180]
[unknown.range]
offset_sigma = 0.005
scale_sigma = 0.003
"""
    job = read_job(tiny_job.write(tmp_path, tiny_job.ARM_JOB + blocks))
    degree = math.radians(1.0)
    assert job.robot is not None
    assert job.range is not None
    assert job.joints == {
        name: 0.02 if kind == "prismatic" else degree
        for name, kind in zip(job.robot.joint_names, job.robot.joint_kinds, strict=True)
    }
    crate = torch.tensor([0.05, 0.05, 0.05, 0.0, 0.0, math.pi], dtype=torch.float64)
    assert_close(job.objects["crate"].sigma, crate)
    assert (job.range.offset_sigma, job.range.scale_sigma) == (0.005, 0.003)
    assert job.frame_poses is None


def test_frames_of_their_own_are_read(tmp_path):
    text = tiny_job.TRIPOD_JOB + "[unknown.frames]\nposition_sigma = 0.1\nrotation_sigma_deg = 0\n"
    job = read_job(tiny_job.write(tmp_path, text))
    expected = torch.tensor([0.1, 0.1, 0.1, 0.0, 0.0, 0.0], dtype=torch.float64)
    assert job.frame_poses is not None
    assert_close(job.frame_poses.sigma, expected)


def test_joints_left_out_are_zero(arm_job):
    for frame, given in zip(
        arm_job.frames, [{"shoulder": 0.1}, {"elbow": -0.2, "lift": 0.05}], strict=True
    ):
        expected = [given.get(name, 0.0) for name in arm_job.robot.joint_names]
        assert_close(frame.joints, torch.tensor(expected, dtype=torch.float64))
        assert frame.T_world_sensor is None


def test_images_are_in_metres_under_their_names(arm_job):
    first, second = (frame.image for frame in arm_job.frames)
    assert (first.name, first.file, second.name) == ("a", "a.png", "b")
    for image in (first, second):
        assert_close(image.range, torch.full((6, 8), 1.5, dtype=torch.float64))
    assert first.usable[:3].all()
    assert not first.usable[3:].any()
    assert second.usable.all()


def test_dtype_is_that_of_every_tensor(tmp_path):
    file = tiny_job.write(tmp_path, tiny_job.ARM_JOB)
    job = read_job(str(file), dtype=torch.float32)
    assert job.base is not None
    assert job.world is not None
    frame = job.frames[0]
    tensors = (job.T_world_base, job.T_link_sensor, job.base.sigma, frame.image.range, frame.joints)
    assert {tensor.dtype for tensor in tensors if tensor is not None} == {torch.float32}
    assert frame.joints is not None
    assert job.world.objects[0].T_world_object.dtype == torch.float32
    assert job.frames[0].image.usable.dtype == torch.bool


def test_hand_held_job_has_poses_instead_of_joints(tmp_path):
    job = read_job(tiny_job.write(tmp_path, tiny_job.TRIPOD_JOB))
    assert job.robot is None
    assert job.link is None
    assert job.base is None
    assert job.frames[0].joints is None
    moved = torch.eye(4, dtype=torch.float64)
    moved[:3, 3] = torch.tensor([1.0, 2, 3])
    assert_close(job.frames[0].T_world_sensor, moved)
    assert isinstance(job.sensor.projection, Spherical)
    assert_close(job.sensor.projection.elevation, (math.pi / 6, -math.pi / 6))


def test_a_search_anywhere_needs_no_pose_of_a_single_frame(tmp_path):
    text = tiny_job.TRIPOD_JOB.replace("pose = { xyz = [1, 2, 3] }\n", "")
    job = read_job(tiny_job.write(tmp_path, text + '[search]\ninitial = "anywhere"\n'))
    assert job.initial == "anywhere"
    assert job.frames[0].T_world_sensor is not None
    assert torch.equal(job.frames[0].T_world_sensor, torch.eye(4, dtype=torch.float64))


def test_frames_of_the_same_name_are_numbered(tmp_path):
    frame = '\n[[frame]]\ndepth = "other/a.png"\npose = {}\n'
    file = tiny_job.write(tmp_path, tiny_job.TRIPOD_JOB + frame)
    (tmp_path / "other").mkdir()
    (tmp_path / "a.png").rename(tmp_path / "other/a.png")
    Image.fromarray(np.full((6, 8), 2000, np.uint16)).save(tmp_path / "a.png")
    job = read_job(file)
    assert [frame.image.name for frame in job.frames] == ["a", "a-2"]
    assert [frame.image.file for frame in job.frames] == ["a.png", "other/a.png"]


def test_robot_alone_may_be_watched_by_a_standing_sensor(tmp_path):
    text = tiny_job.ARM_JOB.replace('[world]\nmodel = "cell.glb"', "")
    file = tiny_job.write(tmp_path, text.replace('link = "tool"', 'link = "world"'))
    job = read_job(file)
    assert job.world is None
    assert job.link == "world"


@pytest.mark.parametrize(
    ("line", "drift"),
    [
        ('drift = "auto"', None),
        ("drift = 0", (0.0, 1.0)),
        ("drift = { sigma = 0.003, pixels = 30 }", (0.003, 30.0)),
    ],
)
def test_drift_is_automatic_none_or_given(tmp_path, line, drift):
    text = tiny_job.TRIPOD_JOB.replace("[[frame]]", f"{line}\n[[frame]]")
    found = read_job(tiny_job.write(tmp_path, text)).sensor.noise.drift
    assert (found and (found.sigma, found.pixels)) == drift


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    file = tiny_job.write(tmp_path, "\ufeff" + tiny_job.TRIPOD_JOB)
    assert len(read_job(file).frames) == 1


@pytest.mark.parametrize("name", ["arc_bin", "lbr_med7"])
def test_recorded_job_is_read(name):
    file = SHARED / "jobs" / name / "job.toml"
    if not file.is_file():
        pytest.skip(f"{file} is missing")
    job = read_job(file)
    assert len(job.frames) == {"arc_bin": 1, "lbr_med7": 5}[name]
    assert all(frame.image.range.isfinite().any() for frame in job.frames)


def test_missing_job_is_one_clear_error(tmp_path):
    with pytest.raises(JobError, match=r"nowhere.toml: found no readable file .*; expected a TOML"):
        read_job(tmp_path / "nowhere.toml")


def test_folder_is_no_job(tmp_path):
    with pytest.raises(JobError, match="found a folder; expected a TOML file"):
        read_job(tmp_path)


def test_bytes_that_are_no_text_are_no_job(tmp_path):
    (tmp_path / "job.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(JobError, match="not UTF-8"):
        read_job(tmp_path / "job.toml")
