"""Trials of the range experiment: what is drawn, and how good an estimate can be."""

import math

import numpy as np
import pytest
import torch
import trimesh

from torchcal.demo import range_trials
from torchcal.demo.machine_hall import random_view
from torchcal.demo.range_trials import cramer_rao, draw_trial, errors, range_sensor, with_start
from torchcal.geometry import se3
from torchcal.model.world import World, WorldObject

SMALL = range_sensor(48)
OFF = (0.1, math.radians(5.0))


def test_the_sensor_is_that_of_the_paper():
    sensor = range_sensor()
    projection = sensor.projection
    assert (projection.width, projection.height, sensor.beam) == (512, 512, 2 * 10 + 1)
    assert float(sensor.noise.sigma(torch.tensor(3.0))) == pytest.approx(0.05)
    edges = torch.tensor([-0.5, 511.5], dtype=torch.float64)
    left, right = projection.rays(edges, torch.zeros(2).double())[:, 0].atan().tolist()
    assert math.degrees(right - left) == pytest.approx(50.0)


def test_a_trial_follows_seed_and_number():
    first, again, other, later = (
        draw_trial(seed, number, offset=OFF, sensor=SMALL)
        for seed, number in ((1, 0), (1, 0), (2, 0), (1, 1))
    )
    assert torch.equal(first.range, again.range)
    assert first.start is not None
    assert again.start is not None
    assert torch.equal(first.start, again.start)
    for different in (other, later):
        assert not torch.equal(first.T_world_sensor, different.T_world_sensor)


def test_the_start_is_off_by_what_was_asked_and_changes_nothing_else():
    trial = draw_trial(0, 0, offset=None, sensor=SMALL)
    assert trial.start is None
    near, far = (with_start(trial, 0, 0, offset) for offset in (OFF, (0.3, math.radians(15.0))))
    for moved, offset in ((near, OFF), (far, (0.3, math.radians(15.0)))):
        assert moved.start is not None
        position, rotation = errors(moved.start, trial.T_world_sensor)
        assert (float(position), float(rotation)) == pytest.approx(offset)
        assert torch.equal(moved.range, trial.range)
    assert with_start(near, 0, 0, None).start is None
    drawn = draw_trial(0, 0, offset=OFF, sensor=SMALL)
    assert drawn.start is not None
    assert near.start is not None
    assert torch.equal(drawn.start, near.start)


def test_starts_of_several_trials_are_off_in_different_directions():
    directions = []
    for number in range(3):
        trial = draw_trial(0, number, offset=OFF, sensor=range_sensor(4))
        assert trial.start is not None
        motion = se3.inverse(trial.T_world_sensor) @ trial.start
        directions.append(motion[:3, 3] / OFF[0])
    cosines = torch.stack(directions) @ torch.stack(directions).mT
    assert float(cosines.triu(1).abs().max()) < 0.99


def test_the_noise_is_that_of_the_sensor():
    quiet = range_trials.replace(SMALL, noise=range_trials.Noise(a=1e-9))
    noisy, exact = (draw_trial(0, 0, offset=None, sensor=each).range for each in (SMALL, quiet))
    deviation = float((noisy - exact).std())
    assert deviation == pytest.approx(0.05, rel=4.0 / math.sqrt(2 * noisy.numel()))  # four sigma


def room() -> World:
    """A box of 4 x 3 x 5 m around the sensor: three pairs of planes."""
    mesh = trimesh.creation.box((4.0, 3.0, 5.0))
    eye = torch.eye(4, dtype=torch.float64)
    return World(objects=(WorldObject(name="room", mesh=mesh, T_world_object=eye),), complete=True)


def test_the_bound_for_one_wall_is_infinite():
    """A sensor 0.5 m before a wall that fills its view: three of six axes change nothing."""
    T = torch.eye(4, dtype=torch.float64)
    T[2, 3] = 2.0
    bound = cramer_rao(T, sensor=range_sensor(24), world=room())
    assert float(bound.diagonal().max()) > 1e6 or not bound.isfinite().all()


def test_the_bound_is_that_of_the_derivatives_by_hand():
    """The depth of a wall ahead at 2.5 m changes by -1 with z: sigma / sqrt(pixels) for z alone."""
    sensor = range_sensor(24)
    T = torch.eye(4, dtype=torch.float64)
    T[2, 3] = 2.0
    meshes = range_trials.meshes_in_world(room())
    step = 1e-3
    poses = [T.clone(), T.clone()]
    poses[0][2, 3] += step
    poses[1][2, 3] -= step
    ahead, behind = (
        range_trials.raycast.predict(
            range_trials.raycast.view(meshes, pose.numpy()), sensor.projection, sensor.beam
        )
        for pose in poses
    )
    np.testing.assert_allclose((ahead - behind) / (2 * step), -1.0, atol=1e-6)


def test_the_bound_falls_with_the_number_of_pixels_and_rises_with_the_noise():
    T = random_view(torch.Generator().manual_seed(0))
    few, many = (cramer_rao(T, sensor=range_sensor(side)) for side in (32, 64))
    ratio = float((few[:3, :3].trace() / many[:3, :3].trace()).sqrt())
    assert 1.4 < ratio < 3.5  # two for planes; the beam of 21 pixels is narrower in the finer image
    loud = range_trials.replace(range_sensor(32), noise=range_trials.Noise(a=0.1))
    torch.testing.assert_close(cramer_rao(T, sensor=loud), 4.0 * few, rtol=1e-6, atol=0.0)


def test_halved_steps_give_the_same_bound():
    T = random_view(torch.Generator().manual_seed(1))
    whole, half = (
        cramer_rao(T, sensor=range_sensor(32), step=step).diagonal().sqrt()
        for step in (range_trials.STEP, 0.5 * range_trials.STEP)
    )
    # The ray caster's samples are discrete, and a pixel of this image is as wide as a box's side.
    torch.testing.assert_close(whole, half, rtol=0.1, atol=0.0)


@pytest.mark.slow
def test_the_bounds_of_the_hall_are_fractions_of_a_millimetre():
    T = draw_trial(0, 0, offset=None, sensor=range_sensor(4)).T_world_sensor
    bound = cramer_rao(T)
    assert 8e-5 < float(bound[:3, :3].trace().sqrt()) < 4e-4
    assert 3e-5 < float(bound[3:, 3:].trace().sqrt()) < 1.3e-4
