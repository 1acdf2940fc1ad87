"""Which states explain the images as well as the best one."""

import math
from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import EYE, prior

from torchcal.calibrate.observation import observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.range_fit import RangeFit
from torchcal.calibrate.rivals import Look, explains_as_well, is_rival
from torchcal.geometry import robust
from torchcal.model.job import Job


def fit_of(job: Job) -> RangeFit:
    scene = build_job_scene(job)
    return RangeFit(
        observation=observe(job),
        surface=scene.surface,
        parameters=Parameters.of(job, scene),
        cutoff=robust.EFFICIENT,
        drift=None,
    )


def with_cube(side: float, rpy: tuple[float, float, float]) -> RangeFit:
    """A cube whose pose is unknown stands where the model has it."""
    meshes = {**recordings.room(), "cube": scenes.box((side,) * 3, (0.2, 0.1, 2.0), rpy)}
    job = recordings.hand_held(
        recordings.sensor(beam=3), [EYE], error=torch.zeros(6).double(), real=meshes
    )
    world = recordings.world_of(meshes)
    return fit_of(replace(job, world=world, base=None, objects={"cube": prior(0.1, 0.5)}))


@pytest.fixture
def small_object() -> RangeFit:
    """It fills a hundredth of the image."""
    return with_cube(0.065, (0.3, 0.2, 0.1))


def test_a_small_object_elsewhere_is_no_rival(small_object):
    """The other pixels, a hundred times as many, have no say."""
    parameters = small_object.parameters
    step = torch.tensor([0.03, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    other = parameters.retract(parameters.nominal, step)
    best = Look.of(small_object, parameters.nominal)
    assert not explains_as_well(small_object, other, best)


def test_a_state_within_the_noise_is_one(small_object):
    parameters = small_object.parameters
    step = torch.tensor([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    other = parameters.retract(parameters.nominal, step)
    assert explains_as_well(small_object, other, Look.of(small_object, parameters.nominal))


def test_a_cube_that_is_turned_by_a_right_angle_is_a_rival():
    fit = with_cube(0.5, (0.0, 0.0, 0.1))
    parameters = fit.parameters
    step = torch.tensor([0.0, 0.0, 0.0, 0.0, 0.0, 0.5 * math.pi], dtype=torch.float64)
    turned = parameters.retract(parameters.nominal, step)
    best = Look.of(fit, parameters.nominal)
    assert is_rival(fit, turned, best)
    slightly = parameters.retract(parameters.nominal, 1e-3 * step)
    assert not is_rival(fit, slightly, best)


def test_a_wall_is_the_same_from_beside(rng):
    wall = {"wall": scenes.wall(2.0)}
    job = recordings.hand_held(
        recordings.sensor(beam=3), [EYE], error=torch.zeros(6).double(), real=wall
    )
    fit = fit_of(replace(job, world=recordings.world_of(wall), base=prior(1.0, 1.0)))
    step = torch.tensor([0.5, -0.3, 0.0, 0.0, 0.0, 0.7], dtype=torch.float64)
    other = fit.parameters.retract(fit.parameters.nominal, step)
    best = Look.of(fit, fit.parameters.nominal)
    assert explains_as_well(fit, other, best)
    # Nothing that lies between is worse: it is one answer that is open along the wall.
    assert not is_rival(fit, other, best)
    nearer = fit.parameters.retract(fit.parameters.nominal, 0.1 * torch.eye(6).double()[2])
    assert not explains_as_well(fit, nearer, best)
