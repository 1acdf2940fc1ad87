"""``initial = "anywhere"``: jobs whose nominal pose says nothing."""

import math
from dataclasses import replace

import numpy as np
import pytest
import recordings
import scenes
import torch
from recordings import EYE, pose, twist

from torchcal.calibrate.anywhere import LEAST_SIDE, locate, without_prior
from torchcal.calibrate.check import check, foresee
from torchcal.calibrate.pipeline import calibrate
from torchcal.calibrate.result import Calibration, Status
from torchcal.errors import TorchcalError
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Job

CAMERA = Pinhole(width=128, height=96, fx=110.0, fy=108.0, cx=62.4, cy=47.8)
SENSOR = recordings.sensor(CAMERA, sigma=0.01, beam=5)
SECOND = pose(0.15, -0.1, 0.1, 0.05, -0.2, 0.1)
ASTRAY = twist(2.0, 1.0, -1.0, 1.0, 2.0, -0.5)
"""m and rad: nothing that a search about the nominal pose would find."""


def answer(job: Job) -> Calibration:
    return calibrate(job, generator=torch.Generator().manual_seed(0))


def hand_held() -> Job:
    job = recordings.hand_held(SENSOR, [EYE, SECOND], error=ASTRAY)
    return replace(job, initial="anywhere")


def test_a_hand_held_sensor_is_found_and_all_frames_share_the_start():
    found = answer(hand_held())
    assert found.estimate.status is Status.CONVERGED
    assert found.job.initial == "anywhere"
    errors = se3.log(se3.inverse(torch.stack([EYE, SECOND])) @ found.estimate.Ts_world_sensor)
    assert float(errors.abs().max()) < 0.002
    assert "look everywhere" in found.timing


def test_the_first_frame_may_show_nothing():
    job = hand_held()
    first, second = job.frames
    nothing = torch.full_like(first.image.range, torch.nan)
    blind = replace(first, image=replace(first.image, range=nothing))
    located = locate(replace(job, frames=(blind, second)), torch.Generator().manual_seed(0))
    assert located.job.frames[1].T_world_sensor is not None
    error = se3.log(se3.inverse(SECOND) @ located.job.frames[1].T_world_sensor)
    assert float(error.norm()) < 0.05


def test_a_frame_that_shows_something_else_does_not_converge():
    strange = {"block": scenes.box((0.7, 0.5, 0.4), (0.1, 0.0, 1.4), (0.3, 0.6, 0.2))}
    job = recordings.hand_held(SENSOR, [EYE], error=ASTRAY, real=strange)
    # A face of the block fits on any wall.
    assert answer(replace(job, initial="anywhere")).estimate.status is not Status.CONVERGED


def test_the_base_of_a_robot_is_found(tmp_path):
    robot = recordings.arm(tmp_path)
    base = pose(-0.3, 0.1, -0.5, 0.1, 0.2, 0.3)
    mount = pose(0.3, 0.0, 0.1, 0.0, 0.3, 0.0)
    postures = [torch.tensor([0.2, -0.3]).double(), torch.tensor([-0.4, 0.1]).double()]
    job = recordings.carried(robot, SENSOR, base, mount, postures)
    told = replace(
        job,
        T_world_base=base @ se3.exp(ASTRAY),
        base=recordings.prior(0.01, 0.01),
        initial="anywhere",
    )
    found = answer(told)
    assert found.estimate.status is Status.CONVERGED
    assert float(se3.log(se3.inverse(base) @ found.estimate.T_world_base).norm()) < 0.005


def tiny(height: int, width: int) -> Job:
    """A job whose only image has few pixels."""
    projection = replace(CAMERA, width=width, height=height)
    job = recordings.hand_held(recordings.sensor(projection, sigma=0.01), [EYE], error=ASTRAY)
    return replace(job, initial="anywhere")


@pytest.mark.parametrize(("height", "width"), [(6, 8), (1, 640), (15, 640)])
def test_images_too_small_for_a_search_are_one_clear_error(height, width):
    with pytest.raises(TorchcalError, match=f"{width} x {height} pixels; expected at least 16 x"):
        locate(tiny(height, width), torch.Generator().manual_seed(0))


@pytest.mark.parametrize("beam", [0, 1, 9])
def test_the_smallest_images_that_can_be_searched_are_searched(beam):
    job = tiny(LEAST_SIDE, LEAST_SIDE)
    job = replace(job, sensor=replace(job.sensor, beam=beam))
    located = locate(job, torch.Generator().manual_seed(0))
    assert located.Ts_world_base.isfinite().all()


def test_without_a_prior_nothing_nominal_is_believed():
    job = without_prior(hand_held())
    room = scenes.box((5.0, 4.0, 7.0), (0.2, -0.1, 0.4), (0.05, 0.1, 0.02))
    diagonal = float(np.linalg.norm(room.extents))
    expected = torch.tensor([diagonal] * 3 + [math.pi] * 3).double()
    assert job.base is not None
    torch.testing.assert_close(job.base.sigma, expected, rtol=1e-6, atol=0.0)
    nominal = replace(hand_held(), initial="nominal")
    assert without_prior(nominal) is nominal
    for each in (
        *check(hand_held()).parameters,
        *foresee(hand_held(), generator=torch.Generator()).parameters,
    ):
        assert each.prior_sigma > 3.0  # the job's own are 0.1
