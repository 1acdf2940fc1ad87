"""The rows that a person reads: units, sigmas, what was held."""

import dataclasses
import tomllib

import numpy as np
from display_scene import calibration, estimate

from torchcal.calibrate.result import NextView
from torchcal.display.summary import axis_sigmas, corrections, next_view_words, settings


def test_held_axes_have_no_sigma():
    found = estimate(1)
    sigmas = axis_sigmas(found.names, found.covariance, "base")
    assert sigmas[2] == 0.0
    np.testing.assert_allclose(sigmas, [0.001, 0.002, 0.0, 0.0003, 0.0004, 0.0005], rtol=1e-12)


def test_corrections_are_in_mm_and_degrees():
    (pose,) = corrections(calibration())
    changes = {row.axis: row.change for row in pose.axes}
    np.testing.assert_allclose(changes["x"], 10.0, rtol=1e-6)  # 0.01 m; kornia's quaternions
    np.testing.assert_allclose(changes["rz"], np.degrees(0.0349), rtol=1e-6)
    assert [row.axis for row in pose.axes if row.held] == ["z"]


def test_settings_name_sensor_and_prior_with_units():
    words = settings(calibration().job)
    assert words["Sensor"] == "pinhole, depth along z, 64 × 48 pixels"
    assert words["Prior of the base"] == "100, 100, 0 mm, 2.865°"
    assert words["Prior of the mount"] == "known exactly"


def test_a_hand_held_pose_is_shown_where_only_single_frames_were_unknown():
    found = calibration()
    prior = found.job.base
    of_frames = dataclasses.replace(found.job, base=None, frame_poses=prior)
    (shown,) = corrections(dataclasses.replace(found, job=of_frames))
    assert shown == corrections(found)[0]


def test_the_next_view_is_toml_whatever_its_joints_are_called():
    joints = {"nod": 0.5, "arm/joint.1 a": -1.0, 'say "x"': 0.25}
    words = next_view_words(NextView(joints=joints, gain=1.0, sigma={}))
    assert tomllib.loads(words) == {"joints": joints}
