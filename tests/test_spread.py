"""Sigma' where P is wide: the tangent on a face, the step to what is behind beside an edge."""

import math
from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import EYE

from torchcal.calibrate.compare import Belief, compare_as_believed
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.result import FrameComparison
from torchcal.calibrate.spread import drawn_steps, moves_far
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import PosePrior

CAMERA = Pinhole(width=96, height=32, fx=80.0, fy=80.0, cx=47.5, cy=15.5)
NEAR, FAR = 2.0, 3.0
"""m: half a wall before a whole one."""


def half_wall(sigma_x: float) -> FrameComparison:
    """The near wall ends at x = 0; only x is uncertain."""
    walls = {
        "near": scenes.sheet((-9, -9, NEAR), (0, -9, NEAR), (0, 9, NEAR), (-9, 9, NEAR)),
        "far": scenes.wall(FAR),
    }
    sensor = recordings.sensor(CAMERA, sigma=0.01)
    prior = PosePrior(sigma=torch.tensor([sigma_x, 0.0, 0.0, 0.0, 0.0, 0.0]).double())
    job = recordings.hand_held(sensor, [EYE], error=torch.zeros(6).double(), base=prior, real=walls)
    job = replace(job, world=recordings.world_of(walls))
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    belief = Belief(
        state=parameters.nominal,
        covariance=torch.diag(parameters.prior_sigma.square()),
        drift_sigma=0.0,
        drift_pixels=0.0,
    )
    (frame,) = compare_as_believed(job, scene, parameters, belief)
    return frame


def beside(metres: float) -> int:
    """The column that sees the near wall so far beside its edge."""
    return round(CAMERA.cx - CAMERA.fx * metres / NEAR)


@pytest.mark.parametrize("sigmas", [0.5, 1.0])
def test_beside_an_edge_sigma_is_the_step_by_the_root_of_its_chance(sigmas):
    frame = half_wall(0.2)
    column = beside(sigmas * 0.2)
    chance = 0.5 * math.erfc(sigmas / math.sqrt(2.0))
    expected = math.hypot(0.01, (FAR - NEAR) * math.sqrt(chance))
    # 32 states: the chance is known to one of them or two.
    assert float(frame.sigma[16, column]) == pytest.approx(expected, rel=0.15)


def test_far_from_any_edge_sigma_is_the_sensors():
    frame = half_wall(0.2)
    torch.testing.assert_close(frame.sigma[:, :8], torch.full((32, 8), 0.01), rtol=1e-4, atol=0)


def test_where_p_is_narrow_only_the_edge_itself_is_uncertain():
    frame = half_wall(0.002)
    sure = (frame.sigma - 0.01).abs() < 1e-5
    assert sure[:, : beside(0.0) - 2].all()
    assert sure[:, beside(0.0) + 4 :].all()


@pytest.mark.parametrize(("sigma", "far"), [(0.002, False), (0.2, True)])
def test_an_image_moves_far_when_it_moves_by_half_the_beam(sigma, far):
    ranges = torch.full((32, 96), NEAR, dtype=torch.float64)
    motion = torch.eye(6, dtype=torch.float64)[None, :, :1]
    P = torch.tensor([[sigma**2]], dtype=torch.float64)
    body = torch.zeros(32, 96, dtype=torch.int64)
    assert moves_far(ranges, body, motion, P, recordings.sensor(CAMERA)) == far


def test_drawn_steps_are_spread_as_p_says_and_always_the_same():
    root = torch.randn(6, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    P = 1e-4 * root @ root.mT
    steps, again = (drawn_steps(P) for _ in range(2))
    torch.testing.assert_close(steps, again, rtol=0, atol=0)
    torch.testing.assert_close(steps.mean(0), torch.zeros(6).double(), atol=1e-12, rtol=0)
    spread = (steps.mT @ steps / len(steps)).diagonal().sqrt()
    # 16 independent draws know a standard deviation to a fifth.
    torch.testing.assert_close(spread, P.diagonal().sqrt(), rtol=0.4, atol=0)
