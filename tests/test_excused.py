"""An object that agrees only because nobody knows where it is tells nothing of where it is."""

from dataclasses import replace

import pytest
import recordings
import torch
from recordings import pose, prior

from torchcal.calibrate import calibrate
from torchcal.calibrate.compare import Belief, compare
from torchcal.calibrate.estimate import nominal_belief
from torchcal.calibrate.excused import excused_objects, told_nothing_of
from torchcal.calibrate.observability import sentences
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.result import Status
from torchcal.model.job import Job


@pytest.fixture
def job() -> Job:
    """Crate and beam are of unknown pose; the crate stands 4 cm farther than the model has it."""
    real = recordings.room()
    real["crate"] = real["crate"].copy().apply_translation([0.0, 0.0, 0.04])
    hand = recordings.hand_held(
        recordings.sensor(sigma=0.002, beam=3),
        [pose(0.1, 0.0, -0.6, 0.05, 0.1, 0.0)],
        error=torch.zeros(6, dtype=torch.float64),
        real=real,
    )
    return replace(hand, base=None, objects={name: prior(0.05, 0.05) for name in ("crate", "beam")})


def excused(job: Job, left: float) -> tuple[tuple[str, ...], Parameters, Belief]:
    """Where the model has everything, with so much of the prior's sigma."""
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    belief = nominal_belief(job, parameters)
    belief = replace(belief, covariance=left**2 * belief.covariance)
    belief, comparisons = compare(job, scene, parameters, belief)
    return excused_objects(job.sensor, scene, parameters, belief, comparisons), parameters, belief


def test_only_what_its_own_uncertainty_excuses_is_named(job):
    assert excused(job, 1.0)[0] == ("crate",)
    assert excused(job, 1e-3)[0] == ()  # then it does not agree


def test_nothing_but_the_prior_is_left_of_it(job):
    _, parameters, belief = excused(job, 0.3)
    P = torch.ones(12, 12, dtype=torch.float64)
    belief = told_nothing_of(("crate",), parameters, replace(belief, covariance=P))
    assert torch.equal(belief.covariance[6:, 6:], P[6:, 6:])
    assert not belief.covariance[:6, 6:].any()
    assert not belief.covariance[6:, :6].any()
    expected = torch.diag(parameters.prior_sigma[:6].square())
    torch.testing.assert_close(belief.covariance[:6, :6], expected, rtol=1e-12, atol=0.0)


def test_a_fit_that_lets_go_of_an_object_says_so(job, monkeypatch):
    """The last fit uses the few pixels of a slope alone, as where all others are beyond its cut."""
    module = __import__("torchcal.calibrate.pipeline", fromlist=["_estimated"])

    def let_go(job, scene, parameters, generator, bases, stages):
        belief, choice = estimated(job, scene, parameters, generator, bases, stages)
        sharp = parameters.prior_sigma.clone()
        sharp[1] *= 1e-3
        P = torch.diag(sharp.square())
        return replace(belief, state=parameters.nominal, covariance=P), choice

    estimated = module._estimated
    monkeypatch.setattr(module, "_estimated", let_go)
    found = calibrate(job, generator=torch.Generator().manual_seed(0))
    assert found.estimate.status is Status.UNOBSERVABLE
    assert "crate" not in found.estimate.moved
    said = sentences(found.estimate.unobservable)
    assert "the whole pose of object crate cannot be told from these images" in said
