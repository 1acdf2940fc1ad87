"""The measurement equation as normal equations, against differences of its cost."""

from dataclasses import replace

import pytest
import recordings
import scenes
import torch
import trimesh
from recordings import EYE, twist

from torchcal.calibrate.observation import observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.range_fit import RangeFit
from torchcal.geometry import robust
from torchcal.geometry.projection import pixel_grid
from torchcal.model.job import Job
from torchcal.model.scene import build_scene
from torchcal.model.sensor import Drift

STEP = 1e-6
TURN = trimesh.transformations.euler_matrix(0.2, -0.3, 0.1)
"""Of the wall z = 0; its last column is the wall's normal."""


def tilted_wall_job(sigma: float = 0.01, beam: int = 3) -> Job:
    """One wall that fills the image and stands askew: nothing but a smooth function of the pose."""
    wall = {"wall": scenes.turned(scenes.wall(0.0), (0.0, 0.0, 2.0), (0.2, -0.3, 0.1))}
    sensor = recordings.sensor(sigma=sigma, beam=beam)
    job = recordings.hand_held(
        sensor, [EYE], error=twist(0.0, 0.0, 0.01, 0.01, -0.01, 0.0), real=wall
    )
    return replace(job, world=recordings.world_of(wall))


def fit_of(
    job: Job, *, cutoff: float = robust.EFFICIENT, drift: Drift | None = None
) -> tuple[RangeFit, Parameters]:
    """In double precision."""
    scene = build_scene(job.world, job.robot, dtype=torch.float64, device=torch.device("cpu"))
    parameters = Parameters.of(job, scene)
    fit = RangeFit(
        observation=observe(job, dtype=torch.float64),
        surface=scene.surface,
        parameters=parameters,
        cutoff=cutoff,
        drift=drift,
    )
    return fit, parameters


@pytest.mark.parametrize("beam", [1, 5])
@pytest.mark.parametrize("cutoff", [robust.EFFICIENT, 1e6])
def test_gradient_is_minus_the_slope_of_the_cost(beam, cutoff):
    fit, parameters = fit_of(tilted_wall_job(beam=beam), cutoff=cutoff)
    state = parameters.nominal
    steps = STEP * torch.eye(6, dtype=torch.float64)
    states = state.expand(6, 2, 4, 4)
    ahead = fit.evaluate(parameters.retract(states, steps)).cost
    behind = fit.evaluate(parameters.retract(states, -steps)).cost
    slope = (ahead - behind) / (2.0 * STEP)
    found = fit.evaluate(state[None]).gradient[0]
    # Costs of 1e4 are known to 1e-12: slopes to 1e-6; gradients are of the size 1e5.
    torch.testing.assert_close(found, -slope, rtol=1e-5, atol=1.0)


def test_information_is_the_curvature_of_the_cost_without_noise():
    quiet = tilted_wall_job(sigma=1e-9)
    job = replace(quiet, sensor=recordings.sensor(sigma=0.01))
    fit, parameters = fit_of(job, cutoff=1e6)
    # At the truth the residuals vanish, and with them what Gauss and Newton leave out.
    truth = parameters.retract(parameters.nominal, twist(0.0, 0.0, 0.01, 0.01, -0.01, 0.0))
    steps = STEP * torch.eye(6, dtype=torch.float64)
    states = truth.expand(6, 2, 4, 4)
    ahead = fit.evaluate(parameters.retract(states, steps)).gradient
    behind = fit.evaluate(parameters.retract(states, -steps)).gradient
    curvature = -(ahead - behind) / (2.0 * STEP)
    information = fit.evaluate(truth[None]).information[0]
    # The prediction takes a pixel's middle for its mean: residuals of some 1e-5 m remain.
    size = float(information.abs().max())
    torch.testing.assert_close(curvature, information, rtol=0, atol=1e-3 * size)


def test_residuals_are_measured_minus_predicted():
    fit, parameters = fit_of(tilted_wall_job(sigma=1e-9))
    truth = parameters.retract(parameters.nominal, twist(0.0, 0.0, 0.01, 0.01, -0.01, 0.0))
    (frame,) = fit.residuals(truth)
    assert frame.compared.all()
    assert not frame.uncompared.any()
    # z'' / 24 with tilts of 0.3 and pixels of 1/55 rad: 3e-5 of 2 m.
    assert float(frame.residual.abs().max()) < 1e-4
    (nearer,) = fit.residuals(parameters.retract(truth, twist(0, 0, 0.1, 0, 0, 0)))
    # 0.1 m nearer to the wall, the prediction is less and the residual positive: along a ray the
    # way to the wall is 0.1 m over the ray's share along the normal times the normal's z.
    normal = torch.from_numpy(TURN[:3, 2].copy())
    grid = pixel_grid(recordings.CAMERA, dtype=torch.float64, device=torch.device("cpu"))
    expected = 0.1 * normal[2] / (recordings.CAMERA.rays(*grid) @ normal)
    inside = (slice(2, -2), slice(2, -2))
    torch.testing.assert_close(nearer.residual[inside], expected[inside], rtol=0.01, atol=0)


def test_a_state_without_overlap_costs_as_much_as_outliers_everywhere():
    fit, parameters = fit_of(tilted_wall_job())
    turned = parameters.nominal.clone()
    turned[0] = turned[0] @ recordings.pose(0, 0, 0, 0, torch.pi, 0)
    equations = fit.evaluate(turned[None])
    offset = parameters.difference(turned, parameters.nominal) / parameters.prior_sigma
    expected = 48 * 64 * robust.EFFICIENT**2 / 6.0 + 0.5 * float(offset.square().sum())
    assert float(equations.cost) == pytest.approx(expected, rel=1e-9)
    precision = torch.diag(parameters.prior_sigma.square().reciprocal())
    torch.testing.assert_close(equations.information[0], precision, rtol=1e-9, atol=1e-9)


def limited_job(offset: float, sigma: float, generator: torch.Generator) -> Job:
    """A wall at 2 m before a sensor that measures from 2 m - ``offset`` on; the rest is lost."""
    wall = {"wall": scenes.wall(2.0)}
    sensor = replace(recordings.sensor(sigma=sigma), near=2.0 - offset)
    job = recordings.hand_held(sensor, [EYE], error=twist(*[0.0] * 6), real=wall)
    noisy = 2.0 + sigma * torch.randn(48, 64, generator=generator, dtype=torch.float64)
    measured = torch.where(noisy >= sensor.near, noisy, torch.nan)
    frames = (recordings.frame_of(measured, T_world_sensor=EYE),)
    return replace(job, world=recordings.world_of(wall), frames=frames)


def test_what_noise_alone_brings_inside_the_limits_is_not_compared(rng):
    """One standard deviation inside, a sixth of the pixels is lost, all of them too near."""
    fit, parameters = fit_of(limited_job(0.05, 0.05, rng))
    (frame,) = fit.residuals(parameters.nominal)
    lost = 1.0 - float(fit.observation.measured.double().mean())
    assert 0.14 < lost < 0.18
    assert not frame.compared.any()
    # They cost what pixels that agree cost on average, and say nothing.
    cost = float(fit.evaluate(parameters.nominal[None]).cost)
    assert cost == pytest.approx(0.5 * int(fit.observation.measured.sum()))


def test_what_is_well_inside_the_limits_is_compared(rng):
    fit, parameters = fit_of(limited_job(0.2, 0.05, rng))
    (frame,) = fit.residuals(parameters.nominal)
    assert frame.compared.all()
    assert not frame.uncompared.any()


def test_frames_without_a_measurement_keep_their_place(rng):
    """Their images need not be predicted."""
    job = limited_job(0.5, 0.05, rng)
    empty = recordings.frame_of(torch.full((48, 64), torch.nan).double(), T_world_sensor=EYE)
    fit, parameters = fit_of(replace(job, frames=(empty, *job.frames, empty)))
    alone, _ = fit_of(job)
    frames = list(fit.residuals(parameters.nominal))
    assert [int(frame.compared.sum()) for frame in frames] == [0, 48 * 64, 0]
    assert [frame.jacobian.shape for frame in frames] == [(48, 64, 6)] * 3
    total = fit.evaluate(parameters.nominal[None])
    expected = alone.evaluate(parameters.nominal[None])
    torch.testing.assert_close(total.information, expected.information)
    torch.testing.assert_close(total.cost, expected.cost)


def test_the_prior_pulls_towards_the_nominal_pose():
    job = tilted_wall_job()
    usable = torch.zeros(48, 64, dtype=torch.bool)
    image = replace(job.frames[0].image, usable=usable)
    fit, parameters = fit_of(replace(job, frames=(replace(job.frames[0], image=image),)))
    step = twist(0.1, -0.05, 0.02, 0.05, 0.01, -0.02)
    equations = fit.evaluate(parameters.retract(parameters.nominal, step)[None])
    precision = parameters.prior_sigma.square().reciprocal()
    torch.testing.assert_close(equations.gradient[0], -precision * step, rtol=1e-9, atol=1e-9)
    expected = 0.5 * (precision * step.square()).sum()
    torch.testing.assert_close(equations.cost[0], expected, rtol=1e-9, atol=0)


def test_frames_add_up():
    job = recordings.hand_held(recordings.sensor(beam=3), [EYE, EYE], error=twist(*[0.0] * 6))
    both, parameters = fit_of(job)
    total = both.evaluate(parameters.nominal[None])
    prior = torch.diag(parameters.prior_sigma.square().reciprocal())
    parts = [
        fit_of(replace(job, frames=(frame,)))[0].evaluate(parameters.nominal[None])
        for frame in job.frames
    ]
    torch.testing.assert_close(
        total.information[0], sum(part.information[0] - prior for part in parts) + prior
    )
    torch.testing.assert_close(total.cost, parts[0].cost + parts[1].cost)


def test_a_slowly_varying_part_leaves_less_information():
    job = tilted_wall_job()
    plain, parameters = fit_of(job)
    drifting, _ = fit_of(job, drift=Drift(sigma=0.01, pixels=10.0))
    before, after = (
        fit.evaluate(parameters.nominal[None]).information[0] for fit in (plain, drifting)
    )
    # Marginalising an unknown never adds information: the difference is positive semidefinite.
    scale = before.diagonal().rsqrt()
    lost = (before - after) * scale * scale[:, None]
    assert float(torch.linalg.eigvalsh(lost)[0]) > -1e-9  # rounding of sums over 3072 pixels
    # Some twenty patches with errors of their own instead of 3072 pixels: 1/150 of it.
    assert float(after[2, 2]) < 0.02 * float(before[2, 2])


def test_a_larger_sigma_scale_lowers_information_by_its_square():
    job = tilted_wall_job()
    plain, parameters = fit_of(job, cutoff=1e6)
    scaled = replace(plain, sigma_scale=2.0)
    prior = torch.diag(parameters.prior_sigma.square().reciprocal())
    one, two = (
        fit.evaluate(parameters.nominal[None]).information[0] - prior for fit in (plain, scaled)
    )
    torch.testing.assert_close(one, 4.0 * two, rtol=1e-6, atol=1e-6 * float(one.max()))
