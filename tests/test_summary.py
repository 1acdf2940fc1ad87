"""The rows that a person reads: units, sigmas, what was held."""

import dataclasses
import tomllib

import numpy as np
import torch
from display_scene import calibration, estimate

from torchcal.calibrate.result import NextView
from torchcal.display.job_settings import settings
from torchcal.display.summary import (
    OWN_AXES,
    axis_sigmas,
    centre_pose,
    corrections,
    distance_words,
    next_view_words,
    size_words,
)
from torchcal.geometry import se3
from torchcal.model.job import PosePrior


def test_held_axes_have_no_sigma():
    found = estimate(1)
    sigmas = axis_sigmas(found.names, found.covariance, "base")
    assert sigmas[2] == 0.0
    np.testing.assert_allclose(sigmas, [0.001, 0.002, 0.0, 0.0003, 0.0004, 0.0005], rtol=1e-12)


def test_corrections_are_in_mm_and_degrees():
    (pose,) = corrections(calibration())
    changes = {row.axis: row.change for row in pose.axes}
    # exp of a twist (0.01 m, 0.0349 rad about z) ends this far along x; kornia's quaternions
    np.testing.assert_allclose(changes["x"], 10.0 * np.sin(0.0349) / 0.0349, rtol=1e-6)
    np.testing.assert_allclose(changes["rz"], np.degrees(0.0349), rtol=1e-6)
    assert [row.axis for row in pose.axes if row.held] == ["z"]


def test_a_correction_is_the_shift_of_the_place_and_not_the_twist():
    """Turned by a quarter about z and shifted by 1 m along its own x, as the job has that."""
    found = calibration()
    believed = found.job.frames[0].T_world_sensor
    assert believed is not None
    quarter = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, np.pi / 2], dtype=torch.float64))
    quarter[0, 3] = 1.0
    Ts = (believed @ quarter).expand_as(found.estimate.Ts_world_sensor)
    moved = dataclasses.replace(found.estimate, Ts_world_sensor=Ts)
    (pose,) = corrections(dataclasses.replace(found, estimate=moved))
    changes = [row.change for row in pose.axes]
    np.testing.assert_allclose(changes, [1000.0, 0.0, 0.0, 0.0, 0.0, 90.0], atol=1e-6)
    assert OWN_AXES in pose.notes
    assert distance_words(believed, Ts[0]) == "1000.0 mm and 90.00° away"


def test_an_object_turned_about_its_centre_has_not_moved():
    found = calibration()
    assert found.job.world is not None
    (crate,) = (item for item in found.job.world.objects if item.name == "crate")
    mesh = crate.mesh.copy()
    mesh.apply_translation((5.0, 0.0, 0.0))  # a file whose origin is elsewhere
    crate = dataclasses.replace(crate, mesh=mesh)
    at = centre_pose(mesh)
    turn = se3.exp(torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.1], dtype=torch.float64))
    T = crate.T_world_object @ at @ turn @ se3.inverse(at)
    prior = PosePrior(sigma=torch.full((6,), 0.05, dtype=torch.float64))
    world = dataclasses.replace(found.job.world, objects=(crate,))
    job = dataclasses.replace(found.job, base=None, world=world, objects={"crate": prior})
    moved = dataclasses.replace(found.estimate, Ts_world_object={"crate": T})
    (pose,) = corrections(dataclasses.replace(found, job=job, estimate=moved))
    changes = [row.change for row in pose.axes]
    np.testing.assert_allclose(changes, [0.0] * 5 + [np.degrees(0.1)], atol=1e-6)


def test_sizes_show_two_digits_of_the_smallest_side():
    assert size_words([0.37, 0.388, 1.2]) == "0.370 × 0.388 × 1.200 m"
    assert size_words([0.37, 0.0031, 0.5]) == "0.3700 × 0.0031 × 0.5000 m"
    assert size_words([0.37, 0.0, 0.5]) == "0.370 × 0.000 × 0.500 m"


def test_settings_name_sensor_and_prior_with_units():
    words = settings(calibration().job)
    assert words["Sensor"] == "pinhole, depth along z, 64 × 48 pixels"
    assert words["Prior of the sensor's pose"] == "100, 100, 0 mm, 2.865°"


def test_settings_of_a_hand_held_sensor_know_no_base_and_no_mount():
    assert not [key for key in settings(calibration().job) if "base" in key or "mount" in key]


def test_of_a_hand_held_sensor_that_is_wrong_alike_in_all_frames_the_first_pose_is_shown():
    (shown,) = corrections(calibration())
    assert shown.title == "Sensor in the world (first frame; the others move with it)"


def test_of_a_hand_held_sensor_every_pose_that_had_its_own_error_is_shown():
    found = calibration()
    prior = found.job.base
    of_frames = dataclasses.replace(found.job, base=None, frame_poses=prior)
    first, second = corrections(dataclasses.replace(found, job=of_frames))
    assert first.title == "Sensor in the world, frame 0001"
    assert second.title == "Sensor in the world, frame 0002"
    assert first.axes == corrections(found)[0].axes
    assert second.axes == first.axes  # the scene's frames are alike


def test_the_next_view_is_toml_whatever_its_joints_are_called():
    joints = {"nod": 0.5, "arm/joint.1 a": -1.0, 'say "x"': 0.25}
    words = next_view_words(NextView(joints=joints, gain=1.0, sigma={}))
    assert tomllib.loads(words) == {"joints": joints}
