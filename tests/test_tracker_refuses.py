"""Frames that a tracker does not believe, and what it says of them."""

import math
from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import frame_of, pose, prior
from torch import Tensor
from tracked_camera import (
    NEVER,
    SENSOR,
    START,
    camera_job,
    distance,
    followed,
    generator,
    seen_from,
)

from torchcal.calibrate.tracked import Tracked, TrackStatus
from torchcal.calibrate.tracker import PATIENCE, Tracker
from torchcal.calibrate.wander import Wander
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Frame, Job, PosePrior

BUMPED = START @ pose(0.05, 0.02, 0.0, 0.0, 0.03, 0.0)
SQUARE = {"room": scenes.box((5.0, 3.0, 5.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))}
"""Looks the same after a quarter of a turn about the vertical."""
INSIDE = pose(0.0, 0.1, 0.0, 0.0, 0.3, 0.0)


def turned(frame: Frame) -> Frame:
    """Half a turn of the image."""
    image = replace(frame.image, range=frame.image.range.flip(0, 1))
    return replace(frame, image=image)


def square_room(quarters: float, sigma: float) -> tuple[Job, Frame]:
    """A camera believed to be turned by so many quarters of a turn, with a sigma (rad)."""
    sigmas = torch.tensor([0.1, 0.0, 0.1, 0.0, sigma, 0.0], dtype=torch.float64)
    job = camera_job(
        INSIDE @ pose(0.0, 0.0, 0.0, 0.0, quarters * math.pi / 2.0, 0.0),
        world=recordings.world_of(SQUARE),
        base=PosePrior(sigma=sigmas),
    )
    return job, frame_of(recordings.record(list(SQUARE.values()), INSIDE, SENSOR, 1))


def first_of(job: Job, frame: Frame) -> Tracked:
    return Tracker.of(job, generator=generator()).step(frame)[1]


def test_a_bump_is_told_however_well_the_pose_was_known():
    tracker, _ = Tracker.of(camera_job(), drift=Wander(share=0.0), generator=generator()).step(
        seen_from(START)
    )
    for times_surer in (1.0, 1e2, 1e6, 1e12):
        sure = replace(tracker, covariance=tracker.covariance / times_surer)
        _, tracked = sure.step(seen_from(BUMPED, seed=1))
        assert (tracked.status, tracked.alarm) == (TrackStatus.TRACKING, True)
        assert distance(tracked, BUMPED) < NEVER


@pytest.mark.parametrize("sigma", [1e-9, 1e-6, 1e-3])
def test_a_belief_that_the_first_frame_contradicts_is_an_alarm(sigma):
    tracked = first_of(camera_job(base=prior(sigma, sigma)), seen_from(BUMPED))
    assert tracked.alarm
    assert distance(tracked, BUMPED) < NEVER


def test_a_camera_that_may_be_in_two_places_is_in_neither():
    job, frame = square_room(quarters=0.5, sigma=0.8)
    assert job.base is not None
    tracker, taken = followed(Tracker.of(job, generator=generator()), [frame] * PATIENCE)
    assert {each.status for each in taken} == {TrackStatus.AMBIGUOUS}
    assert [each.alarm for each in taken] == [False] * (PATIENCE - 1) + [True]
    assert taken[0].message == (
        "1 other pose explains the image as well: none of them is believed, 1 in a row."
    )
    torch.testing.assert_close(taken[-1].T_world_sensor, job.T_world_base)
    assert job.base is not None
    torch.testing.assert_close(
        taken[-1].pose_covariance.diagonal(), job.base.sigma.square(), rtol=1e-9, atol=0.0
    )
    assert tracker.lost == PATIENCE


def test_a_camera_that_is_known_well_enough_is_in_one_of_two_places():
    job, frame = square_room(quarters=0.1, sigma=0.1)
    tracked = first_of(job, frame)
    assert tracked.status == TrackStatus.TRACKING
    assert float(se3.log(se3.inverse(tracked.T_world_sensor) @ INSIDE)[4].abs()) < 0.01


def test_a_first_image_that_was_read_upside_down_is_lost_and_says_why():
    tracked = first_of(camera_job(), turned(seen_from(START)))
    assert tracked.status == TrackStatus.LOST
    assert "fit far better turned by half a turn: the model then explains 100%" in tracked.message
    torch.testing.assert_close(tracked.T_world_sensor, START)


def test_a_first_image_that_is_explained_badly_is_not_as_expected():
    frame = seen_from(START)
    frame.image.range[:, :24] -= 0.5  # no mistake of reading, but something before the camera
    tracked = first_of(camera_job(), frame)
    assert tracked.status == TrackStatus.TRACKING
    assert tracked.agreement < 0.85
    share = f"{100.0 * tracked.agreement:.1f}"
    assert tracked.message == f"The model explains only {share} % of what was measured."


def test_an_image_that_comes_again_tells_nothing_new():
    tracker = Tracker.of(camera_job(), drift=Wander(share=0.0), generator=generator())
    seen, other = seen_from(START), seen_from(START, seed=1)
    seen.image.range[0, 0] = torch.nan
    copy = replace(seen, image=replace(seen.image, range=seen.image.range.clone()))
    _, taken = followed(tracker, [seen, copy, copy, other])
    assert {each.status for each in taken} == {TrackStatus.TRACKING}
    again = "The image is the same as the last one that was used: it tells nothing new."
    assert [each.message == again for each in taken] == [False, True, True, False]
    assert taken[2].agreement == taken[0].agreement
    torch.testing.assert_close(taken[2].covariance, taken[0].covariance, rtol=0.0, atol=0.0)
    assert taken[3].covariance.trace() < 0.7 * taken[0].covariance.trace()


def test_an_image_that_comes_again_from_another_place_contradicts_one_of_the_two():
    """Its driver stands still, or its odometry does not."""
    moved = START @ se3.exp(torch.tensor([0.05, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    tracker = Tracker.of(camera_job(), drift=Wander(share=0.0), generator=generator())
    seen = seen_from(START, nominal=START)
    _, taken = followed(tracker, [seen, replace(seen, T_world_sensor=moved)])
    assert [each.alarm for each in taken] == [False, True]


def test_a_covered_camera_that_sends_the_same_image_is_an_alarm_all_the_same():
    covered = frame_of(torch.full((48, 64), 0.5, dtype=torch.float64))
    frames = [seen_from(START), *[covered] * PATIENCE]
    _, taken = followed(Tracker.of(camera_job(), generator=generator()), frames)
    assert taken[-1].status == TrackStatus.LOST
    assert taken[-1].alarm


@pytest.mark.parametrize("T", [torch.zeros(4, 4), 2.0 * torch.eye(4), torch.eye(4).flip(0)])
def test_a_nominal_pose_that_is_no_rigid_motion_is_no_error(T: Tensor):
    tracked = first_of(camera_job(), replace(seen_from(START), T_world_sensor=T.double()))
    assert tracked.status == TrackStatus.UNUSABLE
    assert "expected a rigid motion" in tracked.message


def test_tensors_that_need_derivatives_are_taken_without():
    frame = seen_from(START, nominal=START.clone().requires_grad_())
    frame = replace(frame, image=replace(frame.image, range=frame.image.range.requires_grad_()))
    tracked = first_of(camera_job(), frame)
    assert tracked.status == TrackStatus.TRACKING
    assert not tracked.T_world_sensor.requires_grad


@pytest.mark.parametrize(("width", "height"), [(1, 48), (64, 1), (1, 1), (1, 500)])
def test_images_of_a_pixel_in_width_or_height_are_no_error(width, height):
    lines = Pinhole(
        width=width, height=height, fx=55.0, fy=54.0, cx=(width - 1) / 2, cy=(height - 1) / 2
    )
    sensor = recordings.sensor(lines)
    ranges = recordings.record(list(recordings.room().values()), START, sensor, 0)
    tracked = first_of(camera_job(sensor=sensor, base=prior(0.01, 0.01)), frame_of(ranges))
    assert tracked.pose_covariance.isfinite().all()
    assert tracked.status != TrackStatus.UNUSABLE
