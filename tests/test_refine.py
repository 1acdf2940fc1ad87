"""The fit on every pixel: error, claimed error and noise model on recordings with a known truth."""

from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import CAMERA, EYE, LIDAR, pose, twist
from torch import Tensor

from torchcal.calibrate.observation import coarse_factor, observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.refine import (
    FINE_PIXELS,
    Refined,
    coarse_fit,
    fine_factor,
    fine_fit,
)
from torchcal.calibrate.reliability import estimated_covariance
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Job

NEARBY = twist(0.01, -0.008, 0.006, 0.004, -0.006, 0.005)
"""What a coarse fit leaves."""
TRUTHS = (EYE, pose(0.15, -0.1, 0.1, 0.05, -0.2, 0.1))
SEEDS = 20


def refined(job: Job) -> tuple[Refined, Parameters]:
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    observation = observe(job)
    found = fine_fit(
        observation,
        scene.surface,
        parameters,
        parameters.nominal,
        factor=fine_factor(observation),
    )
    return found, parameters


def error_and_covariance(job: Job, truth: Tensor = EYE) -> tuple[Tensor, Tensor]:
    """Twist from the true to the estimated pose of the first frame, and what is claimed of it."""
    found, parameters = refined(job)
    J = parameters.pose_jacobians(found.state)[0]
    error = se3.log(se3.inverse(truth) @ parameters.sensor_poses(found.state)[0])
    return error, J @ estimated_covariance(found) @ J.mT


def nees(error: Tensor, covariance: Tensor) -> float:
    """Normalised error squared, for each degree of freedom."""
    return float(error @ torch.linalg.solve(covariance, error)) / len(error)


@pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
@pytest.mark.parametrize("frames", [1, 2])
def test_error_is_a_few_claimed_sigmas(projection, frames):
    sensor = recordings.sensor(projection, sigma=0.02, beam=5)
    job = recordings.hand_held(sensor, list(TRUTHS[:frames]), error=NEARBY)
    error, P = error_and_covariance(job)
    assert float((error.abs() / P.diagonal().sqrt()).max()) < 4.0
    # 3072 pixels of 2 cm, two or three directions from each wall: at most 1 mm and 0.4 mrad.
    assert float(P.diagonal()[:3].sqrt().max()) < 0.0015
    assert float(P.diagonal()[3:].sqrt().max()) < 0.0006


@pytest.mark.slow
def test_claimed_covariance_is_that_of_the_errors():
    sensor = recordings.sensor(sigma=0.02, beam=5)
    scores = [
        nees(*error_and_covariance(recordings.hand_held(sensor, [EYE], error=NEARBY, seed=seed)))
        for seed in range(SEEDS)
    ]
    # The mean of 120 squared standard normals is 1 with a standard deviation of 0.13.
    assert 0.6 < sum(scores) / SEEDS < 1.4


def test_more_frames_tell_more():
    sensor = recordings.sensor(sigma=0.02, beam=5)
    _, one = error_and_covariance(recordings.hand_held(sensor, [EYE], error=NEARBY))
    _, three = error_and_covariance(recordings.hand_held(sensor, [EYE] * 3, error=NEARBY))
    ratio = (one.diagonal() / three.diagonal()).sqrt()
    # Three times the information; the excess scatter of blocks is itself only known to 10 %.
    assert float(ratio.min()) > 1.4
    assert float(ratio.max()) < 2.1


def test_mount_of_a_carried_sensor(tmp_path):
    robot = recordings.arm(tmp_path)
    T_world_base = pose(-0.3, 0.1, -0.2, 0.0, 0.0, 0.0) @ pose(0, 0, 0, 0, -torch.pi / 2, 0)
    T_link_sensor = pose(0.38, 0.02, 0.05, 0, 0, 0) @ pose(0, 0, 0, 0, torch.pi / 2, 0)
    postures = [torch.tensor(q, dtype=torch.float64) for q in ((0.0, 0.0), (0.15, -0.25))]
    sensor = recordings.sensor(sigma=0.02, beam=5)
    truth = recordings.carried(robot, sensor, T_world_base, T_link_sensor, postures)
    wrong = replace(
        truth, T_link_sensor=T_link_sensor @ se3.exp(-NEARBY), mount=recordings.prior(0.02, 0.02)
    )
    found, parameters = refined(wrong)
    assert parameters.names[0] == "mount.x"
    error = se3.log(se3.inverse(T_link_sensor) @ found.state[1])
    sigma = estimated_covariance(found).diagonal().sqrt()
    assert float((error.abs() / sigma).max()) < 4.0
    assert float(sigma[:3].max()) < 0.003
    assert torch.equal(found.state[0], T_world_base)


def test_a_few_unmasked_pixels_are_enough():
    sensor = recordings.sensor(sigma=0.02, beam=5)
    job = recordings.hand_held(sensor, [EYE], error=NEARBY)
    usable = torch.rand(48, 64, generator=torch.Generator().manual_seed(3)) < 0.05
    image = replace(job.frames[0].image, usable=usable)
    error, P = error_and_covariance(replace(job, frames=(replace(job.frames[0], image=image),)))
    assert P.isfinite().all()
    assert float((error.abs() / P.diagonal().sqrt()).max()) < 4.0
    # A twentieth of the pixels: 4.5 times the sigma of all.
    assert float(P.diagonal()[:3].sqrt().max()) < 0.015


def test_sigma_that_the_job_gives_too_small_is_found_in_the_residuals():
    job = recordings.hand_held(recordings.sensor(sigma=0.02, beam=5), [EYE], error=NEARBY)
    job = replace(job, sensor=recordings.sensor(sigma=0.01, beam=5))
    found, _ = refined(job)
    # The median of 3072 residuals is known to 2 %.
    assert found.fit.sigma_scale == pytest.approx(2.0, rel=0.06)


def test_white_noise_is_not_taken_for_drift():
    job = recordings.hand_held(
        recordings.sensor(sigma=0.02, beam=5, drift=None), [EYE], error=NEARBY
    )
    found, _ = refined(job)
    assert found.fit.drift is None or found.fit.drift.sigma < 0.004


def test_coarse_fit_brings_all_candidates_near():
    sensor = recordings.sensor(sigma=0.02, beam=5)
    job = recordings.hand_held(sensor, [EYE], error=NEARBY)
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    steps = torch.stack([torch.zeros(6, dtype=torch.float64), NEARBY, -2.0 * NEARBY])
    starts = parameters.retract(parameters.nominal.expand(3, 2, 4, 4), steps)
    _, solution = coarse_fit(observe(job), scene.surface, parameters, starts)
    errors = se3.log(parameters.sensor_poses(solution.state)[:, 0])
    # Four sigmas of the fine fit; here they are 1.2 mm and 0.5 mrad.
    assert float(errors[:, :3].norm(dim=-1).max()) < 0.004
    assert float(errors[:, 3:].norm(dim=-1).max()) < 0.0016
    # At one cut-off, the same minimum has the same cost: up to steps of a hundredth of a sigma.
    torch.testing.assert_close(
        solution.equations.cost, solution.equations.cost[:1].expand(3), rtol=1e-5, atol=0
    )


@pytest.mark.parametrize(
    ("width", "height", "expected"), [(64, 48, 1), (320, 240, 4), (1920, 1080, 8), (640, 50, 1)]
)
def test_coarsest_image_has_some_sixty_rows(width, height, expected):
    assert coarse_factor(observed(width, height, beam=1).sensor) == expected


def test_wide_beams_are_never_averaged():
    assert fine_factor(observed(2000, 1000, beam=5)) == 1


def test_large_sharp_images_are_averaged_to_the_limit():
    observation = observed(2000, 1000, beam=1)
    factor = fine_factor(observation)
    assert factor == 2
    assert observation.range.numel() / factor**2 <= FINE_PIXELS


def test_frames_that_measured_nothing_do_not_make_the_others_coarser():
    one = observed(1000, 800, beam=1)
    ranges, measured, sigma = (
        each.expand(4, -1, -1) for each in (one.range, one.measured, one.sigma)
    )
    four = replace(one, range=ranges, measured=measured, sigma=sigma)
    others = torch.tensor([True, False, True, True])[:, None, None].expand_as(measured)
    assert fine_factor(four) == 2
    assert fine_factor(one) == fine_factor(four.without(others)) == 1


def observed(width: int, height: int, beam: int):
    """An image of one value."""
    projection = Pinhole(width=width, height=height, fx=500.0, fy=500.0, cx=0.0, cy=0.0)
    ranges = torch.ones(height, width, dtype=torch.float64)
    job = recordings.hand_held(recordings.sensor(), [EYE], error=NEARBY)
    return observe(
        replace(
            job,
            sensor=recordings.sensor(projection, beam=beam),
            frames=(recordings.frame_of(ranges, T_world_sensor=EYE),),
        )
    )


def test_what_is_out_of_view_does_not_hide_that_neighbouring_errors_are_alike(rng):
    """The same images and an object far behind the wall: no surer of the pose than without it."""
    job = recordings.hand_held(recordings.sensor(), [EYE], error=NEARBY)
    bumps = 0.01 * torch.randn(1, 1, 6, 8, generator=rng, dtype=torch.float64)
    bumps = torch.nn.functional.interpolate(bumps, size=(48, 64), mode="bicubic")[0, 0]
    frame = job.frames[0]
    uneven = replace(frame.image, range=frame.image.range + bumps)
    far = scenes.box((1.0, 1.0, 1.0), (0.0, 0.0, 50.0), (0.0, 0.0, 0.0))
    world = recordings.world_of({**recordings.room(), "far": far})
    job = replace(job, world=world, frames=(replace(frame, image=uneven),))
    found, _ = refined(job)
    more, parameters = refined(replace(job, objects={"far": recordings.prior()}))
    own = [parameters.names.index(name) for name in found.fit.parameters.names]
    P = estimated_covariance(more)[own][:, own]
    torch.testing.assert_close(P, estimated_covariance(found), rtol=1e-3, atol=0.0)
