"""Jobs in single precision: estimated with all digits, answered in their own."""

from dataclasses import replace

import pytest
import recordings
import torch
from recordings import EYE, pose, prior, twist
from torch import Tensor

from torchcal.calibrate.check import check, foresee
from torchcal.calibrate.pipeline import calibrate, predict
from torchcal.calibrate.result import Status
from torchcal.model.job import Job, PosePrior
from torchcal.model.precision import job_in_double

SENSOR = recordings.sensor(sigma=0.01)
POSTURES = [torch.tensor([0.2 * k - 0.4, -1.1 - 0.1 * k]).double() for k in range(2)]


def single(values: Tensor | None) -> Tensor | None:
    return None if values is None else values.float()


def in_single(job: Job) -> Job:
    frames = (
        replace(
            frame,
            image=replace(frame.image, range=frame.image.range.float()),
            joints=single(frame.joints),
            T_world_sensor=single(frame.T_world_sensor),
        )
        for frame in job.frames
    )
    return replace(
        job,
        T_world_base=job.T_world_base.float(),
        T_link_sensor=job.T_link_sensor.float(),
        frames=tuple(frames),
        base=None if job.base is None else PosePrior(sigma=job.base.sigma.float()),
    )


@pytest.fixture(params=["hand held", "carried"])
def job(request, tmp_path) -> Job:
    if request.param == "hand held":
        return recordings.hand_held(SENSOR, [EYE], error=twist(0.03, 0.02, -0.03, 0.02, 0.03, 0))
    base, mount = pose(0.0, 0.0, -0.6, 0.0, 0.0, 0.0), pose(0.25, 0.0, 0.08, 0, 1.3, 0)
    carried = recordings.carried(recordings.arm(tmp_path), SENSOR, base, mount, POSTURES)
    return replace(carried, base=prior(0.03, 0.03), joints={"nod": 0.02})


def seeded() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_a_job_in_single_precision_is_calibrated_like_one_in_double(job):
    found, expected = (calibrate(each, generator=seeded()) for each in (in_single(job), job))
    assert found.estimate.status is Status.CONVERGED
    assert found.estimate.Ts_world_sensor.dtype == torch.float32
    assert found.estimate.covariance.dtype == torch.float32
    assert expected.estimate.Ts_world_sensor.dtype == torch.float64
    # Ranges and poses of some metres in single precision: about 1e-6; the rest is what a step is
    # cut off at.
    torch.testing.assert_close(
        found.estimate.Ts_world_sensor.double(),
        expected.estimate.Ts_world_sensor,
        rtol=0.0,
        atol=1e-4,
    )
    assert (found.next_view is None) == (job.robot is None)


def test_a_job_in_single_precision_is_checked_and_foreseen(job):
    ahead = foresee(in_single(job), generator=seeded())
    for each in (*check(in_single(job)).parameters, *ahead.parameters):
        assert each.expected_sigma < each.prior_sigma
    assert all(image.isfinite().any() for image in predict(in_single(job)))


def test_all_of_a_job_is_in_double_and_nothing_else_changes(job):
    again = job_in_double(in_single(job))
    assert {again.T_world_base.dtype, again.frames[0].image.range.dtype} == {torch.float64}
    ranges, expected = again.frames[-1].image.range, job.frames[-1].image.range
    torch.testing.assert_close(ranges, expected, rtol=1e-6, atol=0.0, equal_nan=True)
    assert again.base is not None
    assert again.base.sigma.dtype == torch.float64
    assert again.joints == job.joints
    assert in_single(job).T_world_base.dtype == torch.float32
