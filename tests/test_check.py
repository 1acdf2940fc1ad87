"""What a job says of itself before anything is estimated."""

from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import EYE, twist

from torchcal.calibrate.check import check
from torchcal.calibrate.observation import observe
from torchcal.calibrate.parameters import AXES, Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.refine import fine_fit
from torchcal.calibrate.reliability import estimated_covariance
from torchcal.model.job import Job

SENSOR = recordings.sensor(sigma=0.02, beam=5)


def room_job(frames: int = 1) -> Job:
    return recordings.hand_held(SENSOR, [EYE] * frames, error=twist(*[0.0] * 6))


def with_image(job: Job, **changes: torch.Tensor) -> Job:
    """The first frame's image with other ranges or another mask."""
    frame = job.frames[0]
    return replace(
        job, frames=(replace(frame, image=replace(frame.image, **changes)), *job.frames[1:])
    )


def test_a_good_job_has_no_warning():
    found = check(room_job(2))
    assert [frame.name for frame in found.frames] == ["frame-0", "frame-1"]
    assert found.warnings == ()
    assert found.unobservable == ()
    for frame in found.frames:
        assert frame.warnings == ()
        assert frame.measured_fraction == frame.usable_fraction == frame.model_fraction == 1.0
        # The room is seen from where it was recorded; only noise is between the medians.
        assert frame.median_range_m == pytest.approx(frame.predicted_median_range_m, abs=0.02)


def test_expected_sigmas_are_those_of_a_fit():
    job = room_job()
    found = check(job).parameters
    assert [each.name for each in found] == [f"base.{axis}" for axis in AXES]
    assert [each.prior_sigma for each in found] == pytest.approx([0.1] * 6)
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    fit = fine_fit(observe(job), scene.surface, parameters, parameters.nominal, factor=1)
    claimed = estimated_covariance(fit).diagonal().sqrt()
    ratio = torch.tensor([each.expected_sigma for each in found]).to(claimed) / claimed
    # The biweight costs the fit 3 %, and the scatter of this image's blocks of pixels, of which
    # only an excess is believed, 15 %: in all directions alike.
    assert 0.8 < float(ratio.min()) <= float(ratio.max()) < 1.0
    assert float(ratio.max() / ratio.min()) < 1.02


def test_fractions_count_missing_and_masked_pixels():
    job = room_job()
    ranges = job.frames[0].image.range.clone()
    ranges[:12] = torch.nan
    usable = torch.ones(48, 64, dtype=torch.bool)
    usable[:, :16] = False
    (frame,) = check(with_image(job, range=ranges, usable=usable)).frames
    assert frame.measured_fraction == pytest.approx(0.75)
    assert frame.usable_fraction == pytest.approx(0.75 * 0.75)


@pytest.mark.parametrize("factor", [1000.0, 0.1])
def test_a_wrong_unit_is_warned_of(factor):
    job = room_job()
    (frame,) = check(with_image(job, range=factor * job.frames[0].image.range)).frames
    assert len(frame.warnings) == 1
    assert "depth_unit" in frame.warnings[0]
    # The medians of measurement and model differ by the noise.
    assert frame.median_range_m / frame.predicted_median_range_m == pytest.approx(factor, rel=0.01)


def test_a_model_that_is_elsewhere_is_warned_of():
    job = replace(room_job(), world=recordings.world_of({"far": scenes.box((1, 1, 1), (0, 0, -9))}))
    (frame,) = check(job).frames
    assert frame.model_fraction == 0.0
    assert any("the model fills only 0.0%" in warning for warning in frame.warnings)
    assert torch.tensor(frame.predicted_median_range_m).isnan()


def test_few_usable_pixels_are_warned_of():
    usable = torch.zeros(48, 64, dtype=torch.bool)
    usable[10:12] = True
    (frame,) = check(with_image(room_job(), usable=usable)).frames
    assert any("only 4.2% of the pixels" in warning for warning in frame.warnings)


def test_a_wall_alone_is_known_to_leave_three_directions_open():
    wall = {"wall": scenes.wall(2.0)}
    job = recordings.hand_held(SENSOR, [EYE], error=twist(*[0.0] * 6), real=wall)
    found = check(replace(job, world=recordings.world_of(wall)))
    assert len(found.unobservable) == 3
    left = {each.name: each.expected_sigma / each.prior_sigma for each in found.parameters}
    # 3072 pixels of 2 cm and a prior of 0.1 m: 0.36 mm, and 0.7 mrad at a lever of half a metre.
    assert left["base.z"] < 0.005
    assert left["base.rx"] < 0.01
    assert left["base.x"] > 0.95
    assert left["base.rz"] > 0.95


def test_a_job_without_unknowns_says_so():
    found = check(replace(room_job(), base=None))
    assert found.parameters == ()
    assert found.unobservable == ()
    assert found.warnings == ("The job declares nothing unknown.",)
