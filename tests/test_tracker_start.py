"""Where a tracker begins, what noise it finds there, and how little it computes twice."""

from dataclasses import replace

import numpy as np
import recordings
import torch
from recordings import frame_of, pose, prior, twist
from scipy.ndimage import gaussian_filter
from scipy.stats import chi2
from torch import Tensor
from tracked_camera import (
    NEVER,
    START,
    camera_job,
    distance,
    followed,
    generator,
    seen_from,
)

from torchcal.calibrate.range_fit import RangeFit
from torchcal.calibrate.tracked import TrackStatus
from torchcal.calibrate.tracker import Tracker
from torchcal.calibrate.wander import Wander
from torchcal.demo import tracking_trials
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import PosePrior
from torchcal.model.sensor import Noise

LARGE = recordings.sensor(Pinhole(width=128, height=96, fx=110.0, fy=108.0, cx=62.4, cy=47.8))
ASTRAY = twist(2.0, 1.0, -1.0, 1.0, 2.0, -0.5)
"""m and rad: nothing that a search about the nominal pose would find."""


def test_the_first_frame_is_found_anywhere_and_odometry_goes_on_from_it():
    truths = [START @ pose(*(0.05 * k * v for v in (1, -1, 0, 0.5, 1, 0.5))) for k in range(3)]
    job = recordings.hand_held(LARGE, truths, error=ASTRAY)
    u, v = torch.meshgrid(torch.arange(128.0), torch.arange(96.0), indexing="xy")
    strange = frame_of((1.5 + 0.4 * (u / 6.0).sin() * (v / 5.0).cos()).double())
    tracker = Tracker.of(
        replace(job, initial="anywhere"),
        drift=Wander(blocks={"base": prior(0.001, 0.001)}),
        generator=generator(),
    )
    assert (tracker.covariance.diagonal().sqrt() > 3.0).all()
    tracker, first = tracker.step(strange)
    assert first.status != TrackStatus.TRACKING
    assert tracker.job.initial == "anywhere"
    _, taken = followed(tracker, list(job.frames))
    assert {each.status for each in taken} == {TrackStatus.TRACKING}
    assert not any(each.alarm for each in taken)
    for each, truth in zip(taken, truths, strict=True):
        assert distance(each, truth) < NEVER


def test_what_is_sought_anywhere_drifts_by_what_the_job_believes_or_is_usual():
    job = camera_job(initial="anywhere", base=prior(0.5, 0.25))
    for each, expected in ((job, (0.005, 0.0025)), (replace(job, base=None), (0.001, 0.001))):
        drift = Tracker.of(each, generator=generator()).drift
        torch.testing.assert_close(drift, torch.tensor(expected).double().repeat_interleave(3))


def test_the_answer_has_the_precision_of_the_job():
    job = camera_job()
    single = replace(
        job,
        T_world_base=START.float(),
        T_link_sensor=job.T_link_sensor.float(),
        base=PosePrior(sigma=prior().sigma.float()),
    )
    frame = seen_from(START)
    image = replace(frame.image, range=frame.image.range.float())
    _, tracked = Tracker.of(single, generator=generator()).step(replace(frame, image=image))
    assert tracked.status == TrackStatus.TRACKING
    of_pose = (tracked.T_world_sensor, tracked.pose_covariance, tracked.state)
    assert {each.dtype for each in of_pose} == {torch.float32}
    _, expected = Tracker.of(job, generator=generator()).step(frame)
    # Single precision of the ranges and the pose: 1e-7 of some metres.
    torch.testing.assert_close(
        tracked.T_world_sensor.double(), expected.T_world_sensor, rtol=0.0, atol=1e-5
    )


def slowly_varying(shape: torch.Size, sigma: float, pixels: float) -> Tensor:
    """A Gaussian field (m) of this correlation length."""
    noise = np.random.default_rng(0).standard_normal(shape)
    smooth = gaussian_filter(noise, pixels / 2**0.5, mode="wrap")
    return torch.from_numpy(sigma * smooth / smooth.std())


def test_a_slowly_varying_range_error_that_nobody_declared_is_in_the_covariance():
    sensor = replace(
        tracking_trials.depth_camera(320), noise=Noise(a=0.002, b=0.0, c=0.0, drift=None)
    )
    meshes = list(recordings.room().values())
    clean = torch.from_numpy(tracking_trials.cast(meshes, START, sensor))
    noise = 0.002 * torch.randn(clean.shape, generator=generator(), dtype=torch.float64)
    ranges = clean + noise + slowly_varying(clean.shape, 0.002, 20.0)
    tracker = Tracker.of(camera_job(sensor=sensor), generator=generator())
    tracker, tracked = tracker.step(frame_of(ranges))
    assert tracker.trust is not None
    assert tracker.trust.drift is not None
    assert tracker.trust.drift.pixels * 2 >= 30.0  # in blocks of two pixels
    assert 0.001 < tracker.trust.drift.sigma < 0.003
    assert distance(tracked, START) < chi2.ppf(0.997, 6)


def test_no_state_is_predicted_twice_on_the_way_to_where_rays_lead(monkeypatch):
    tracker, _ = Tracker.of(camera_job(), generator=generator()).step(seen_from(START))
    seen: list[Tensor] = []
    residuals = RangeFit.residuals

    def watched(fit: RangeFit, state: Tensor):
        seen.append(state)
        return residuals(fit, state)

    monkeypatch.setattr(RangeFit, "residuals", watched)
    tracker.step(seen_from(START @ pose(0.01, 0.01, 0.0, 0.01, 0.0, 0.01), seed=1))
    assert len({tuple(state.flatten().tolist()) for state in seen}) >= len(seen) - 1
    assert len(seen) <= 9
