"""What images will tell, against the same images once they are there."""

from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import pose, prior

from torchcal.calibrate import foresight
from torchcal.calibrate.check import foresee
from torchcal.calibrate.foresight import foreseen_covariance, next_view
from torchcal.calibrate.observation import observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.range_fit import RangeFit
from torchcal.model.job import Job, PosePrior
from torchcal.model.range_image import RangeImage
from torchcal.solve.gauss_newton import covariance

POSTURES = [torch.tensor([0.3, -0.2]).double(), torch.tensor([-0.5, 0.4]).double()]


@pytest.fixture
def job(tmp_path) -> Job:
    """A sensor before the arm's tool, two joints and the base unknown."""
    carried = recordings.carried(
        recordings.arm(tmp_path),
        recordings.sensor(beam=3, sigma=0.01),
        pose(0.1, -0.3, 0.2, 0.0, -1.4, 0.0),
        pose(0.5, 0.0, 0.0, 0.0, 1.4, 0.0),
        POSTURES,
    )
    return replace(carried, base=prior(0.05, 0.05), joints={"turn": 0.02, "nod": 0.02})


def blank(job: Job) -> Job:
    frames = (
        replace(frame, image=RangeImage.blank(frame.image.name, frame.image.file, job.sensor))
        for frame in job.frames
    )
    return replace(job, frames=tuple(frames))


def test_what_is_foreseen_is_what_the_images_tell(job):
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    fit = RangeFit(
        observation=observe(job),
        surface=scene.surface,
        parameters=parameters,
        cutoff=1e9,
        drift=None,
    )
    told = covariance(fit.evaluate(parameters.nominal[None]).information[0])
    foreseen = foreseen_covariance(blank(job), scene, parameters, parameters.nominal)
    torch.testing.assert_close(
        foreseen.diagonal().sqrt(), told.diagonal().sqrt(), rtol=0.02, atol=0.0
    )


def test_the_next_view_tells_what_it_promises(job, rng):
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    P = foreseen_covariance(job, scene, parameters, parameters.nominal)
    found = next_view(job, scene, parameters.nominal, P, rng)
    assert found is not None
    joints = torch.tensor(list(found.joints.values()), dtype=torch.float64)
    limits = job.robot.joint_limits
    assert ((joints >= limits[:, 0]) & (joints <= limits[:, 1])).all()
    more = replace(job, frames=(*job.frames, replace(job.frames[0], joints=joints)))
    own = Parameters.of(more, scene)
    after = foreseen_covariance(more, scene, own, own.nominal)
    expected = dict(zip(own.names, after.diagonal().sqrt().tolist(), strict=True))
    assert found.sigma == pytest.approx(expected, rel=1e-6)
    told = 0.5 * (torch.linalg.slogdet(P).logabsdet - torch.linalg.slogdet(after).logabsdet)
    assert found.gain == pytest.approx(float(told), rel=1e-6)


def test_the_next_view_is_within_limits_that_moved_with_the_zero(job, rng):
    """They are moved by more than they are apart: no value is within both."""
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    step = torch.zeros(len(parameters.names)).double()
    for joint in ("turn", "nod"):
        step[parameters.names.index(f"joints.{joint}")] = 6.5
    state = parameters.retract(parameters.nominal, step)
    found = next_view(job, scene, state, torch.eye(len(step)).double(), rng)
    assert found is not None
    joints = torch.tensor(list(found.joints.values()), dtype=torch.float64)
    low, high = (job.robot.joint_limits - 6.5).unbind(1)
    assert ((joints >= low) & (joints <= high)).all()


def test_the_next_view_tells_more_than_one_that_was_taken(job, rng):
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    P = foreseen_covariance(job, scene, parameters, parameters.nominal)
    found = next_view(job, scene, parameters.nominal, P, rng)
    again = replace(job, frames=(*job.frames, job.frames[0]))
    own = Parameters.of(again, scene)
    repeated = foreseen_covariance(again, scene, own, own.nominal)
    gain = 0.5 * (torch.linalg.slogdet(P).logabsdet - torch.linalg.slogdet(repeated).logabsdet)
    assert found is not None
    assert found.gain > float(gain)


def test_what_is_known_exactly_is_as_if_it_were_held(job, rng, monkeypatch):
    monkeypatch.setattr(foresight, "VIEWS", 4)
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    P = foreseen_covariance(job, scene, parameters, parameters.nominal)
    P[0], P[:, 0] = 0.0, 0.0
    before = rng.get_state()
    found = next_view(job, scene, parameters.nominal, P, rng)
    sigma = torch.tensor([0.0, *[0.05] * 5], dtype=torch.float64)
    held = replace(job, base=PosePrior(sigma=sigma))
    expected = next_view(held, scene, parameters.nominal, P[1:, 1:], rng.set_state(before))
    assert found is not None
    assert expected is not None
    assert found.joints == expected.joints
    assert found.gain == pytest.approx(expected.gain, rel=1e-9)
    assert found.sigma == pytest.approx({"base.x": 0.0, **expected.sigma}, rel=1e-9, abs=1e-15)


def test_nobody_can_move_a_sensor_without_joints(rng):
    sensor = recordings.sensor(beam=3)
    hand = recordings.hand_held(sensor, [recordings.EYE], error=torch.zeros(6).double())
    found = foresee(blank(hand), generator=rng)
    assert found.next_view is None
    assert [each.name for each in found.parameters][:2] == ["base.x", "base.y"]
    assert all(each.expected_sigma < 0.1 * each.prior_sigma for each in found.parameters)


def test_what_the_base_and_the_first_joint_share_is_named(job, rng):
    """The first joint turns about the base's own z."""
    words = [each.words for each in foresee(job, generator=rng).unobservable]
    assert words == [
        "a turn of the base about z and the offset of joint turn cannot be told apart in these "
        "images"
    ]


def test_no_view_is_named_where_none_tells_anything(job, rng):
    """Of a crate behind the wall no image says anything."""
    far = scenes.box((1.0, 1.0, 1.0), (0.0, 0.0, 50.0), (0.0, 0.0, 0.0))
    world = recordings.world_of({**recordings.room(), "far": far})
    hidden = replace(job, world=world, base=None, joints={}, objects={"far": prior()})
    assert foresee(hidden, generator=rng).next_view is None
