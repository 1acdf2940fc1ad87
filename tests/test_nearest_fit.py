"""Points to nearest patches, and the search that starts with them, from starts that are far off."""

import math
from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import EYE, pose, twist
from torch import Tensor

from torchcal.calibrate.nearest_fit import NearestFit
from torchcal.calibrate.observation import Observation, observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.search import APART, best_apart, candidate_states, states_are_apart
from torchcal.geometry import se3
from torchcal.model.job import Job, PosePrior
from torchcal.model.scene import Surface
from torchcal.solve.gauss_newton import GaussNewtonConfig, minimise, shared

FAR_OFF = twist(0.12, -0.12, 0.1, 0.1, -0.1, 0.1)
"""0.2 m and 10 degrees."""


def setting(job: Job) -> tuple[Observation, Surface, Parameters]:
    scene = build_job_scene(job)
    return observe(job), scene.surface, Parameters.of(job, scene)


def room_job(error: Tensor, truths: tuple[Tensor, ...] = (EYE,)) -> Job:
    """A wide beam, so that no pixel is left out."""
    sensor = recordings.sensor(beam=3)
    prior = recordings.prior(0.2, 0.17)
    return recordings.hand_held(sensor, list(truths), error=error, base=prior)


def fit_of(job: Job, state: Tensor, rng: torch.Generator, count: int = 600) -> NearestFit:
    observation, surface, parameters = setting(job)
    return NearestFit.of(observation, surface, parameters, state, count=count, generator=rng)


def error_of(state: Tensor, truth: Tensor) -> tuple[float, float]:
    xi = se3.log(se3.inverse(truth) @ state)
    return float(xi[:3].norm()), float(xi[3:].norm())


def test_a_fit_from_nearby_ends_near_the_truth(rng):
    job = room_job(0.3 * FAR_OFF)
    _, _, parameters = setting(job)
    state = parameters.nominal
    for _ in range(2):
        fit = fit_of(job, state, rng)
        config = GaussNewtonConfig(iterations=20)
        state = minimise(shared(fit.evaluate), parameters.retract, state[None], config).state[0]
    position, rotation = error_of(parameters.sensor_poses(state)[0], EYE)
    # The beam rounds off edges by centimetres and patches lie 4 to 7 cm apart.
    assert position < 0.03
    assert rotation < 0.02


def test_the_search_from_far_off_ends_near_the_truth(rng):
    truths = (EYE, pose(0.15, -0.1, 0.1, 0.05, -0.2, 0.1))
    job = room_job(FAR_OFF, truths)
    observation, surface, parameters = setting(job)
    best = candidate_states(observation, surface, parameters, rng)[0]
    for found, truth in zip(parameters.sensor_poses(best), truths, strict=True):
        position, rotation = error_of(found, truth)
        assert position < 0.03
        assert rotation < 0.02


def test_gradient_is_zero_and_cost_least_at_the_truth_without_noise(rng):
    sensor = replace(recordings.sensor(sigma=1e-6, beam=0), noise=recordings.sensor().noise)
    job = recordings.hand_held(
        recordings.sensor(sigma=1e-6, beam=0), [EYE], error=twist(*[0.0] * 6)
    )
    job = replace(job, sensor=sensor)
    _, _, parameters = setting(job)
    fit = fit_of(job, parameters.nominal, rng)
    states = torch.stack([parameters.nominal, parameters.nominal @ pose(0.05, 0, 0, 0, 0, 0)])
    at_truth, beside = fit.evaluate(states).cost.tolist()
    # Points lie on the planes of their patches up to single precision.
    assert at_truth < 1e-6 * beside


def test_residuals_are_explained_by_the_jacobian(rng):
    job = room_job(twist(*[0.0] * 6))
    _, _, parameters = setting(job)
    fit = fit_of(job, parameters.nominal, rng)
    step = 1e-6
    steps = step * torch.eye(6, dtype=torch.float64)
    errors, jacobian = fit._correspondences(parameters.nominal[None])
    ahead, _ = fit._correspondences(
        parameters.retract(parameters.nominal.expand(6, 2, 4, 4), steps)
    )
    slopes = ((ahead - errors) / step).movedim(0, -1)
    same = (slopes + jacobian[0]).abs().amax(-1) < 1e-3
    # A few points get another patch within the step.
    assert float(same[fit.valid].double().mean()) > 0.99


def test_a_batch_of_states_is_a_loop_over_states(rng):
    job = room_job(FAR_OFF)
    _, _, parameters = setting(job)
    fit = fit_of(job, parameters.nominal, rng, count=200)
    steps = torch.linspace(-0.1, 0.1, 18, dtype=torch.float64).view(3, 6)
    states = parameters.retract(parameters.nominal.expand(3, 2, 4, 4), steps)
    together = fit.evaluate(states)
    for i in range(3):
        alone = fit.evaluate(states[i : i + 1])
        for name in ("cost", "information", "gradient"):
            torch.testing.assert_close(
                getattr(together, name)[i], getattr(alone, name)[0], rtol=1e-9, atol=1e-6
            )


def test_fewer_measured_points_than_asked_for_are_all_taken(rng):
    job = room_job(FAR_OFF)
    usable = torch.zeros(48, 64, dtype=torch.bool)
    usable[20:25, 30:40] = True
    image = replace(job.frames[0].image, usable=usable)
    job = replace(job, frames=(replace(job.frames[0], image=image),))
    _, _, parameters = setting(job)
    fit = fit_of(job, parameters.nominal, rng, count=500)
    assert int(fit.valid.sum()) == 50
    expected = job.frames[0].image.range[usable].sort().values.float().double()
    torch.testing.assert_close(fit.points[0, fit.valid[0], 2].sort().values, expected)


def test_a_frame_without_measurement_leaves_the_prior(rng):
    job = room_job(FAR_OFF)
    image = replace(job.frames[0].image, usable=torch.zeros(48, 64, dtype=torch.bool))
    job = replace(job, frames=(replace(job.frames[0], image=image),))
    _, _, parameters = setting(job)
    equations = fit_of(job, parameters.nominal, rng).evaluate(parameters.nominal[None])
    precision = torch.diag(parameters.prior_sigma.square().reciprocal())
    torch.testing.assert_close(equations.information[0], precision, rtol=1e-12, atol=0)
    assert float(equations.cost) == 0.0


@pytest.mark.parametrize(("share", "expected"), [(0.9, False), (1.1, True)])
def test_states_are_apart_beyond_a_tenth_of_a_prior_sigma(share, expected):
    _, _, parameters = setting(room_job(FAR_OFF))
    step = torch.zeros(6, dtype=torch.float64)
    step[4] = share * APART * parameters.prior_sigma[4]
    other = parameters.retract(parameters.nominal, step)
    assert states_are_apart(other, parameters.nominal, parameters) is expected


def test_distinct_states_are_the_best_that_are_apart():
    _, _, parameters = setting(room_job(FAR_OFF))
    steps = torch.zeros(4, 6, dtype=torch.float64)
    steps[:, 0] = torch.tensor([0.0, 0.001, 0.2, 0.4], dtype=torch.float64)
    states = parameters.retract(parameters.nominal.expand(4, 2, 4, 4), steps)
    costs = torch.tensor([3.0, 2.0, torch.nan, 1.0], dtype=torch.float64)
    kept = torch.stack(best_apart(states, costs, parameters, 4))
    # The first lies beside the second, which is better; what has no cost comes last.
    torch.testing.assert_close(kept, states[[3, 1, 2]], rtol=0, atol=0)
    torch.testing.assert_close(kept[:2], torch.stack(best_apart(states, costs, parameters, 2)))


def test_a_state_that_contradicts_the_prior_crowds_out_none_that_does_not():
    _, _, parameters = setting(room_job(FAR_OFF))
    steps = torch.zeros(3, 6, dtype=torch.float64)
    steps[:, 0] = torch.tensor([6.0, 1.0, 2.0], dtype=torch.float64) * parameters.prior_sigma[0]
    states = parameters.retract(parameters.nominal.expand(3, 2, 4, 4), steps)
    costs = torch.tensor([1.0, 3.0, 2.0], dtype=torch.float64)
    kept = torch.stack(best_apart(states, costs, parameters, 3))
    torch.testing.assert_close(kept, states[[2, 1, 0]], rtol=0, atol=0)


@pytest.mark.parametrize("seed", range(3))
def test_both_corners_of_a_square_room_are_found(seed):
    """A prior of 0.8 rad about the vertical holds two turns that are a right angle apart."""
    sigma = torch.tensor([0.1, 0.0, 0.1, 0.05, 0.8, 0.05], dtype=torch.float64)
    turn = torch.tensor([0.0, 0.0, 0.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    meshes = {"room": scenes.box((5.0, 3.0, 5.0), (0.0, 0.0, 0.0))}
    job = recordings.hand_held(
        recordings.sensor(beam=3), [EYE], error=turn, base=PosePrior(sigma=sigma), real=meshes
    )
    job = replace(job, world=recordings.world_of(meshes))
    observation, surface, parameters = setting(job)
    generator = torch.Generator().manual_seed(seed)
    states = candidate_states(observation, surface, parameters, generator)
    turns = parameters.difference(states, parameters.nominal)[:, parameters.names.index("base.ry")]
    for expected in (1.0, 1.0 - 0.5 * math.pi):
        assert float((turns - expected).abs().min()) < 0.02
