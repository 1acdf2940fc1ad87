"""What each part of q moves, against finite differences of the poses themselves."""

from dataclasses import replace

import pytest
import recordings
import torch
from kinematic_jobs import (
    assert_derivatives_are_right,
    parameters_of,
    with_everything,
)
from recordings import pose, prior

from torchcal.calibrate.parameters import AXES
from torchcal.geometry import se3
from torchcal.model.job import PosePrior
from torchcal.model.robot import load_robot

EXACT = 1e-12
"""Products of a few 4x4 matrices of size 1 in double precision."""


def test_derivatives_of_a_carried_sensor(robot_job):
    assert_derivatives_are_right(parameters_of(robot_job))


def test_derivatives_of_a_standing_sensor(robot_job):
    parameters = parameters_of(recordings.standing(robot_job, pose(0.5, 1.0, 2.0, 0.3, 1.0, 0.2)))
    assert_derivatives_are_right(parameters)


def test_derivatives_without_a_robot(hand_job):
    assert_derivatives_are_right(parameters_of(hand_job))


def test_derivatives_with_held_axes(robot_job):
    sigma = torch.tensor([0.1, 0.0, 0.1, 0.0, 0.2, 0.0], dtype=torch.float64)
    job = replace(robot_job, base=PosePrior(sigma=sigma), mount=PosePrior(sigma=sigma.flip(0)))
    assert_derivatives_are_right(parameters_of(job))


def test_derivatives_of_joints_objects_and_range(robot_job):
    assert_derivatives_are_right(parameters_of(with_everything(robot_job)))


def test_derivatives_of_a_standing_sensor_and_joints(robot_job):
    job = recordings.standing(with_everything(robot_job), pose(0.5, 1.0, 2.0, 0.3, 1.0, 0.2))
    assert_derivatives_are_right(parameters_of(job))


def test_derivatives_of_frames_of_their_own_beside_objects(hand_job):
    job = replace(hand_job, base=None, frame_poses=prior(), objects={"crate": prior()})
    parameters = parameters_of(job)
    assert_derivatives_are_right(parameters)
    assert parameters.names[:7] == (
        *(f"objects.crate.{axis}" for axis in AXES),
        "frames.1.x",
    )
    assert parameters.active(1).tolist() == [*range(6), *range(12, 18)]


def test_derivatives_of_a_shared_correction_beside_frames_of_their_own(hand_job):
    assert_derivatives_are_right(parameters_of(replace(hand_job, frame_poses=prior(0.01, 0.01))))


def test_a_mimic_joint_moves_with_the_offset_of_its_leader(robot_job, tmp_path):
    file = tmp_path / "mimic.urdf"
    text = (tmp_path / "arm.urdf").read_text()
    moving = '<joint name="nod" type="revolute">'
    text = text.replace(moving, moving + '<mimic joint="turn" multiplier="-1.5" offset="0.2"/>')
    file.write_text(text)
    frames = tuple(replace(frame, joints=frame.joints[:1]) for frame in robot_job.frames)
    job = replace(robot_job, robot=load_robot(file), frames=frames, joints={"turn": 0.1})
    assert_derivatives_are_right(parameters_of(job))


def test_names_of_all_blocks_in_the_order_of_the_result(robot_job):
    job = replace(with_everything(robot_job), base=None, mount=prior(0.01, 0.02))
    names = parameters_of(job).names
    assert names == (
        "joints.nod",
        "joints.turn",
        *(f"mount.{axis}" for axis in AXES),
        *(f"objects.shelf.{axis}" for axis in AXES),
        *(f"objects.crate.{axis}" for axis in AXES),
        "range.offset",
        "range.scale",
    )


def test_an_offset_adds_to_what_was_read(robot_job):
    parameters = parameters_of(replace(robot_job, base=None, mount=None, joints={"nod": 0.1}))
    state = parameters.retract(parameters.nominal, torch.tensor([0.07]).double())
    shifted = tuple(
        replace(f, joints=f.joints + torch.tensor([0.0, 0.07])) for f in robot_job.frames
    )
    expected = parameters_of(replace(robot_job, frames=shifted))
    assert parameters.joint_offsets(state).tolist() == pytest.approx([0.07])
    torch.testing.assert_close(
        parameters.bodies_in_sensor(state),
        expected.bodies_in_sensor(expected.nominal),
        atol=EXACT,
        rtol=0,
    )


def test_an_object_turns_about_the_centre_of_its_bounding_box(robot_job):
    parameters = parameters_of(
        replace(robot_job, base=None, mount=None, objects={"crate": prior()})
    )
    step = torch.tensor([0.0, 0.0, 0.0, 0.3, -0.2, 0.5], dtype=torch.float64)
    T = parameters.object_poses(parameters.retract(parameters.nominal, step))[0]
    centre = torch.as_tensor(recordings.room()["crate"].bounds.mean(0))
    # Vertices, and so the centre, are of single precision.
    torch.testing.assert_close(se3.transform(T, centre[None])[0], centre, atol=1e-6, rtol=0)
    torch.testing.assert_close(T[:3, :3], se3.exp(step)[:3, :3], atol=EXACT, rtol=0)


def test_bodies_that_move_alike(robot_job):
    alike = parameters_of(robot_job).mechanism.moving_alike.tolist()
    assert alike == [0, 0, 0, 0, 4, 4]  # beam, crate, room, shelf; upper, tool
    apart = parameters_of(with_everything(robot_job)).mechanism.moving_alike
    assert len(apart.unique()) == 5
