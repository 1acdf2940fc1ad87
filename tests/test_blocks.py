"""Calibrations of joints, objects, the sensor's range and single frames, against the truth."""

from dataclasses import replace

import pytest
import recordings
import torch
from recordings import EYE, pose, prior
from torch import Tensor

from torchcal.calibrate import calibrate
from torchcal.calibrate.compare import Belief
from torchcal.calibrate.estimate import moved_objects
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.result import Calibration, Status
from torchcal.demo.calibration_trials import Trial, draw_trial, outcome
from torchcal.model.job import Job, RangePrior

NEES = (0.15, 3.0)
"""Of single recordings with 6 to 12 parameters: 1 in 1000 is outside."""


SENSOR = recordings.sensor(beam=3, sigma=0.005)


@pytest.fixture
def arm_job(tmp_path) -> Job:
    """A sensor before the arm's tool in three postures, nothing unknown."""
    postures = [torch.tensor(each).double() for each in ([0.3, -0.2], [-0.4, 0.2], [0.0, 0.1])]
    return recordings.carried(
        recordings.arm(tmp_path),
        SENSOR,
        pose(0.1, -0.1, -0.6, 0.0, -1.4, 0.0),
        pose(0.5, 0.0, 0.0, 0.0, 1.4, 0.0),
        postures,
    )


def hand_job(frames: int) -> Job:
    truths = [pose(0.1 * k, -0.05 * k, 0.02 * k, 0.02 * k, 0.1 * k, 0.05) for k in range(frames)]
    return replace(recordings.hand_held(SENSOR, truths, error=torch.zeros(6).double()), base=None)


def found(job: Job, seed: int, rng: torch.Generator) -> tuple[Trial, Calibration]:
    trial = draw_trial(job, seed, 0)
    return trial, calibrate(trial.job, generator=rng)


def assert_right(trial: Trial, calibration: Calibration, most: float = 1.6) -> None:
    """Found, as near as the claimed covariance says, and as near as the images allow."""
    result = outcome(trial, calibration)
    assert calibration.estimate.status == Status.CONVERGED
    count = len(result.error)
    nees = float(result.error @ torch.linalg.solve(result.covariance, result.error)) / count
    assert NEES[0] < nees < NEES[1]
    claimed, least = (P.diagonal().sqrt() for P in (result.covariance, result.least))
    assert (claimed < most * least).all()
    assert (claimed > 0.9 * least).all()


def test_offsets_of_joints(arm_job, rng):
    trial, calibration = found(replace(arm_job, joints={"turn": 0.02, "nod": 0.02}), 1, rng)
    assert_right(trial, calibration)
    parameters = Parameters.of(trial.job, build_job_scene(trial.job))
    offsets = parameters.joint_offsets(trial.state).tolist()
    assert list(calibration.estimate.joint_offsets.values()) == pytest.approx(offsets, abs=1e-3)


def test_two_objects_and_nobody_else_is_accused(arm_job, rng):
    job = replace(arm_job, objects={"crate": prior(0.05, 0.05), "beam": prior(0.05, 0.05)})
    trial, calibration = found(job, 2, rng)
    assert_right(trial, calibration)
    verdicts = {name: each.verdict for name, each in calibration.update.verdicts.items()}
    assert verdicts == {"beam": "moved", "crate": "moved", "room": "agrees", "shelf": "agrees"}
    assert calibration.update.added == ()


def test_an_object_where_the_model_has_it_has_not_moved(arm_job, rng):
    job = replace(arm_job, objects={"crate": prior(0.05, 0.05)})
    calibration = calibrate(job, generator=rng)
    assert calibration.update.verdicts["crate"].verdict == "agrees"
    assert calibration.estimate.moved == ()


def test_an_object_without_a_covariance_is_not_said_to_have_moved(arm_job):
    """Where the estimate failed, the covariance is NaN."""
    job = replace(arm_job, objects={"crate": prior(0.05, 0.05), "beam": prior(0.05, 0.05)})
    parameters = Parameters.of(job, build_job_scene(job))
    step = torch.ones(len(parameters.names)).double()
    P = torch.eye(len(step)).double() * 1e-4
    belief = Belief(
        state=parameters.retract(parameters.nominal, step),
        covariance=P,
        drift_sigma=0.0,
        drift_pixels=0.0,
    )
    assert moved_objects(parameters, belief) == ("crate", "beam")
    crate = [name.startswith("objects.crate") for name in parameters.names]
    P[crate] = torch.nan
    assert moved_objects(parameters, belief) == ("beam",)


def test_what_no_image_tells_is_no_sign_of_a_move(arm_job):
    job = replace(arm_job, objects={"crate": prior(0.05, 0.05)})
    parameters = Parameters.of(job, build_job_scene(job))
    left = torch.tensor([0.01, 0.9, 0.9, 0.9, 0.9, 0.9], dtype=torch.float64)  # x alone is told

    def moved(*step: float) -> tuple[str, ...]:
        off = parameters.prior_sigma * torch.tensor(step, dtype=torch.float64)
        belief = Belief(
            state=parameters.retract(parameters.nominal, off),
            covariance=torch.diag((left * parameters.prior_sigma).square()),
            drift_sigma=0.0,
            drift_pixels=0.0,
        )
        return moved_objects(parameters, belief)

    assert moved(0.0, 9.0, 9.0, 9.0, 0.0, 0.0) == ()
    assert moved(0.1, 0.0, 0.0, 0.0, 0.0, 0.0) == ("crate",)


def test_the_sensors_own_range_error_beside_its_pose(rng):
    job = replace(hand_job(2), base=prior(), range=RangePrior(offset_sigma=0.02, scale_sigma=0.01))
    trial, calibration = found(job, 3, rng)
    assert_right(trial, calibration)


def test_a_sensor_that_reads_too_far_beside_its_pose(rng):
    """1 % and 5 mm: the truth is given, all else is drawn."""
    job = replace(hand_job(2), base=prior(), range=RangePrior(offset_sigma=0.02, scale_sigma=0.02))
    trial = draw_trial(job, 7, 0, known={"range.offset": 0.005, "range.scale": 0.01})
    parameters = Parameters.of(trial.job, build_job_scene(trial.job))
    assert parameters.range_error(trial.state).tolist() == pytest.approx([0.005, 0.01], abs=1e-12)
    calibration = calibrate(trial.job, generator=rng)
    assert_right(trial, calibration)
    result = outcome(trial, calibration)
    z = (result.error / result.covariance.diagonal().sqrt())[-2:]
    assert z.abs().max() < 3.0
    assert calibration.estimate.range_scale == pytest.approx(0.01, abs=0.002)


def test_frames_of_their_own_beside_an_object(rng):
    job = replace(hand_job(3), frame_poses=prior(0.03, 0.03), objects={"crate": prior(0.03, 0.03)})
    trial, calibration = found(job, 4, rng)
    assert_right(trial, calibration)


def test_an_unseen_object_is_unobservable(arm_job, rng):
    """It stands behind the sensor."""
    hidden = recordings.scenes.box((0.3, 0.3, 0.3), (0.0, 0.0, -2.0), (0.1, 0.2, 0.3))
    world = recordings.world_of({**recordings.room(), "hidden": hidden})
    job = replace(arm_job, world=world, objects={"hidden": prior()})
    calibration = calibrate(draw_trial(job, 5, 0).job, generator=rng)
    assert calibration.estimate.status == Status.UNOBSERVABLE
    words = {each.words for each in calibration.estimate.unobservable}
    assert "the whole pose of object hidden cannot be told from these images" in words
    assert calibration.update.verdicts["hidden"].verdict == "unseen"


def test_a_standing_sensor_watches_an_arm_with_wrong_joints(arm_job, rng):
    T_world_sensor: Tensor = pose(0.2, 0.1, -2.2, 0.0, 0.05, 0.1)
    job = recordings.standing(replace(arm_job, T_world_base=EYE), T_world_sensor)
    job = replace(job, joints={"turn": 0.03, "nod": 0.03})
    trial, calibration = found(job, 6, rng)
    # The arm fills so few blocks of pixels that their scatter overstates the covariance.
    assert_right(trial, calibration, most=3.0)
