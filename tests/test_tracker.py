"""The tracker follows what moves, is honest about it, and cries out when something was bumped."""

import math
import re
from dataclasses import replace

import pytest
import recordings
import torch
from recordings import frame_of, pose, prior, twist
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

from torchcal.calibrate.tracked import TrackStatus
from torchcal.calibrate.tracker import PATIENCE, Tracker
from torchcal.calibrate.wander import Wander
from torchcal.errors import TorchcalError
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import RangePrior

FREE = Wander(blocks={"base": prior(0.03, 0.04)})


def test_a_camera_without_odometry_is_followed_and_its_sigmas_are_honest():
    steps = [twist(0.02, 0.01, -0.01, 0.01, -0.02, 0.02), twist(-0.01, 0.0, 0.02, 0.0, 0.03, 0.0)]
    truths = [START @ pose(0.03, -0.05, 0.02, 0.02, 0.0, -0.03)]
    for k in range(15):
        truths.append(truths[-1] @ se3.exp(steps[k % 2]))
    tracker = Tracker.of(camera_job(), drift=FREE, generator=generator())
    _, taken = followed(tracker, [seen_from(T, seed=k) for k, T in enumerate(truths)])
    assert {each.status for each in taken} == {TrackStatus.TRACKING}
    assert not any(each.alarm for each in taken)
    distances = [distance(each, truth) for each, truth in zip(taken, truths, strict=True)]
    assert max(distances) < NEVER
    # 16 times 6 degrees of freedom: three sigmas of the mean are 0.43.
    assert sum(distances) / len(distances) / 6.0 == pytest.approx(1.0, abs=0.43)


def test_a_bump_of_a_centimetre_is_told_at_once_and_nothing_before_or_after_it():
    before, bump = START @ pose(0.02, 0.0, 0.03, 0.0, 0.02, 0.0), pose(0.0, 0.01, 0, 0, 0, 0)
    truths = [before] * 8 + [before @ bump] * 5
    tracker = Tracker.of(camera_job(), generator=generator())
    _, taken = followed(tracker, [seen_from(T, seed=k) for k, T in enumerate(truths)])
    assert [k for k, each in enumerate(taken) if each.alarm] == [8]
    assert "a shift of the sensor along y" in taken[8].message
    assert taken[8].p_value < 1e-6
    for each, truth in zip(taken, truths, strict=True):
        assert distance(each, truth) < NEVER


def test_something_new_before_the_camera_is_no_alarm_and_not_as_the_model_says():
    truth = START @ pose(0.02, 0.0, 0.03, 0.0, 0.02, 0.0)
    plain, changed = seen_from(truth, seed=1), seen_from(truth, seed=2)
    rows, columns = changed.image.range.shape
    changed.image.range[: rows // 2, : columns // 2] -= 0.5
    _, taken = followed(Tracker.of(camera_job(), generator=generator()), [plain, changed])
    assert [(each.status, each.alarm) for each in taken] == [(TrackStatus.TRACKING, False)] * 2
    shares = [
        float(re.findall(r"as expected; the model agrees with ([0-9.]+) % of", each.message)[0])
        for each in taken
    ]
    assert shares[0] > 97.0
    # A quarter of the image, and the blocks that it cuts.
    assert 65.0 < shares[1] < 76.0


def test_what_stands_still_is_known_better_from_frame_to_frame():
    tracker = Tracker.of(camera_job(), drift=Wander(share=0.0), generator=generator())
    _, taken = followed(tracker, [seen_from(START, seed=k) for k in range(4)])
    sigmas = [float(each.covariance.diagonal().sum()) ** 0.5 for each in taken]
    assert sigmas[3] == pytest.approx(sigmas[0] / 2.0, rel=0.05)  # as four frames together


def test_a_covered_camera_is_lost_and_found_again():
    covered = frame_of(torch.full((48, 64), 0.5, dtype=torch.float64))
    frames = [seen_from(START), *[covered] * PATIENCE, seen_from(START, seed=1)]
    _, taken = followed(Tracker.of(camera_job(), generator=generator()), frames)
    lost = taken[1:-1]
    assert {each.status for each in lost} == {TrackStatus.LOST}
    assert [each.alarm for each in lost] == [False] * (PATIENCE - 1) + [True]
    torch.testing.assert_close(lost[-1].T_world_sensor, taken[0].T_world_sensor)
    assert (lost[-1].covariance.diagonal() > taken[0].covariance.diagonal()).all()
    assert taken[-1].status == TrackStatus.TRACKING
    assert not taken[-1].alarm
    assert distance(taken[-1], START) < NEVER


def test_a_camera_that_jumps_far_is_found_by_a_search():
    tracker = Tracker.of(camera_job(), generator=generator())
    jump = START @ pose(0.03, 0.05, -0.05, 0.0, 0.05, 0.06)
    _, taken = followed(tracker, [seen_from(START), seen_from(jump, seed=1)])
    assert taken[1].alarm
    assert distance(taken[1], jump) < NEVER


@pytest.mark.parametrize(
    ("frame", "words"),
    [
        (frame_of(torch.full((48, 64), torch.nan)), "no measured pixel"),
        (frame_of(torch.full((48, 64), 100.0)), "no measured pixel"),
        (frame_of(torch.ones(24, 32)), r"shape (24, 32)"),
        (frame_of(torch.ones(48, 64), T_world_sensor=torch.eye(4) * math.nan), "nominal pose"),
    ],
)
def test_a_frame_that_cannot_be_used_changes_no_estimate(frame, words):
    tracker, first = Tracker.of(camera_job(), generator=generator()).step(seen_from(START))
    tracker, tracked = tracker.step(frame)
    assert tracked.status == TrackStatus.UNUSABLE
    assert words in tracked.message
    torch.testing.assert_close(tracked.state, first.state)
    tracker, tracked = tracker.step(seen_from(START, seed=1))
    assert tracked.status == TrackStatus.TRACKING


def test_a_first_frame_that_cannot_be_used_leaves_the_prior():
    tracker = Tracker.of(camera_job(), generator=generator())
    tracker, tracked = tracker.skip("a", "It was not there.")
    assert (tracked.name, tracked.message) == ("a", "It was not there.")
    torch.testing.assert_close(tracked.pose_covariance.diagonal().sqrt(), prior().sigma)
    tracker, tracked = tracker.step(seen_from(START))
    assert distance(tracked, START) < NEVER


def test_odometry_is_believed_as_far_as_it_was_right():
    error = twist(0.04, -0.02, 0.03, 0.02, 0.05, -0.03)
    truths = [START @ pose(*(0.1 * k * v for v in (1, -1, 0, 0.5, 1, 0.5))) for k in range(4)]
    job = recordings.hand_held(SENSOR, truths, error=error)
    tracker = Tracker.of(job, drift=Wander(share=0.001), generator=generator())
    _, taken = followed(tracker, list(job.frames))
    assert not any(each.alarm for each in taken)
    for each, truth in zip(taken, truths, strict=True):
        assert distance(each, truth) < NEVER
    torch.testing.assert_close(taken[-1].corrections, error, atol=2e-3, rtol=0.0)


def test_errors_of_single_frames_do_not_last():
    own = prior(0.01, 0.01)
    errors = [pose(*(0.01 * sign * v for v in (1, -1, 1, -1, 1, 1))) for sign in (1, -1, 1)]
    frames = [seen_from(START @ error, seed=k, nominal=START) for k, error in enumerate(errors)]
    job = camera_job(frame_poses=own, frames=tuple(frames))
    tracker = Tracker.of(job, drift=Wander(share=0.0), generator=generator())
    _, taken = followed(tracker, frames)
    assert taken[0].names[6:] == tuple(f"frames.1.{a}" for a in ("x", "y", "z", "rx", "ry", "rz"))
    assert not any(each.alarm for each in taken)
    for each, error in zip(taken, errors, strict=True):
        assert distance(each, START @ error) < NEVER
    # The base is what three frames of 1 cm have in common, although each is known to 1 mm.
    base = taken[-1].covariance.diagonal()[:3].sqrt()
    torch.testing.assert_close(base, torch.full((3,), 0.01 / 3**0.5).double(), rtol=0.05, atol=0.0)


def test_a_robots_joint_offset_is_found_and_a_slip_of_the_joint_is_told(tmp_path):
    robot = recordings.arm(tmp_path)
    T_base, T_mount = pose(0.0, 0.0, -0.6, 0.0, 0.0, 0.0), pose(0.25, 0.0, 0.08, 0, 1.3, 0)
    postures = [torch.tensor([0.2 * k - 0.4, -1.1 - 0.1 * k]).double() for k in range(5)]
    slip = torch.tensor([0.0, 0.03]).double()
    real = [*postures[:3], postures[3] + slip, postures[4] + slip]
    job = recordings.carried(robot, SENSOR, T_base, T_mount, real)
    frames = [replace(f, joints=q) for f, q in zip(job.frames, postures, strict=True)]
    unknown = replace(job, frames=(), joints={"nod": math.radians(2.0)})
    _, taken = followed(Tracker.of(unknown, generator=generator()), frames)
    assert [each.alarm for each in taken] == [False, False, False, True, False]
    assert "the offset of joint nod" in taken[3].message
    sigma = taken[-1].covariance[0, 0].sqrt()
    assert abs(taken[-1].corrections[0] - 0.03) < 5.0 * sigma
    _, tracked = Tracker.of(unknown, generator=generator()).step(replace(frames[0], joints=None))
    assert "joint values None" in tracked.message


def test_jobs_that_cannot_be_tracked_are_named():
    with pytest.raises(TorchcalError, match="found nothing unknown"):
        Tracker.of(camera_job(base=None), generator=generator())
    tiny = replace(SENSOR, projection=Pinhole(width=8, height=6, fx=9.0, fy=9.0, cx=3.5, cy=2.5))
    with pytest.raises(TorchcalError, match=r"anywhere.* with images of 8 x 6 pixels"):
        Tracker.of(camera_job(initial="anywhere", sensor=tiny), generator=generator())


@pytest.mark.parametrize(
    ("drift", "words"),
    [
        (Wander(share=-1.0), "found -1.0 for share"),
        (Wander(share=math.nan), "found nan"),
        (Wander(blocks={"mount": prior()}), "found 'mount'; expected"),
        (Wander(blocks={"base": 0.1}), "expected a PosePrior"),
        (Wander(blocks={"base": prior(-1.0)}), "found -1.0 for base"),
        (Wander(blocks={"range.scale": prior()}), "expected a number"),
    ],
)
def test_a_drift_that_makes_no_sense_is_named(drift, words):
    job = camera_job(range=RangePrior(offset_sigma=0.01, scale_sigma=0.01))
    with pytest.raises(TorchcalError, match=words):
        Tracker.of(job, drift=drift, generator=generator())


def test_unnamed_unknowns_drift_by_a_share_of_their_prior():
    job = camera_job(range=RangePrior(offset_sigma=0.01, scale_sigma=0.02))
    drift = Wander(share=0.1, blocks={"base": prior(0.5, 0.6), "range.scale": 0.003})
    tracker = Tracker.of(job, drift=drift, generator=generator())
    expected = torch.tensor([0.5] * 3 + [0.6] * 3 + [0.001, 0.003]).double()
    torch.testing.assert_close(tracker.drift, expected)
