"""Eq. 1, 4 and 5 against tables, hand calculations and counted false alarms."""

from dataclasses import fields, replace

import pytest
import recordings
import scenes
import torch
from recordings import CAMERA, EYE

from torchcal.calibrate.compare import (
    Belief,
    classify,
    compare,
    reclassified,
    without_range_error,
)
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.result import FrameComparison, PixelClass
from torchcal.geometry.projection import pixel_grid
from torchcal.model.job import Job

ALPHA = 3.0
NAN = float("nan")
WALL = 2.5


def label(measured: float, predicted: float, sigma: float = 0.01, usable: bool = True) -> int:
    z, model, sigmas = (torch.full((1, 1), value) for value in (measured, predicted, sigma))
    return int(classify(z, model, sigmas, torch.full((1, 1), usable), ALPHA))


@pytest.mark.parametrize(
    ("measured", "predicted", "expected"),
    [
        (2.0, 2.0, PixelClass.AGREES),
        (2.0 + 0.029, 2.0, PixelClass.AGREES),
        (2.0 - 0.029, 2.0, PixelClass.AGREES),
        (2.0 - 0.031, 2.0, PixelClass.NEARER),
        (2.0 + 0.031, 2.0, PixelClass.FARTHER),
        (NAN, 2.0, PixelClass.MISSING),
        (2.0, NAN, PixelClass.UNMODELLED),
        (NAN, NAN, PixelClass.NOT_COMPARED),
    ],
)
def test_class_of_a_pixel(measured, predicted, expected):
    assert label(measured, predicted) == expected
    assert label(measured, predicted, usable=False) == PixelClass.NOT_COMPARED


def test_a_larger_sigma_forgives_more():
    assert label(2.05, 2.0, sigma=0.01) == PixelClass.FARTHER
    assert label(2.05, 2.0, sigma=0.02) == PixelClass.AGREES


def wall_job(sigma: float = 0.02, frames: int = 1) -> Job:
    """A wall across the axis, ``WALL`` m away; every frame has noise of its own."""
    sensor = recordings.sensor(CAMERA, sigma=sigma)
    ranges = [recordings.record([scenes.wall(WALL)], EYE, sensor, seed) for seed in range(frames)]
    job = recordings.hand_held(sensor, [EYE], error=torch.zeros(6, dtype=torch.float64))
    return replace(
        job,
        world=recordings.world_of({"wall": scenes.wall(WALL)}),
        frames=tuple(recordings.frame_of(each, T_world_sensor=EYE) for each in ranges),
    )


def believed_and_compared(
    job: Job, covariance: torch.Tensor, *, drift_sigma: float = 0.0, drift_pixels: float = 0.0
) -> tuple[Belief, tuple[FrameComparison, ...]]:
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    known = Belief(
        state=parameters.nominal,
        covariance=covariance,
        drift_sigma=drift_sigma,
        drift_pixels=drift_pixels,
    )
    return compare(job, scene, parameters, known)


def compared(job: Job, covariance: torch.Tensor, **belief: float) -> tuple[FrameComparison, ...]:
    return believed_and_compared(job, covariance, **belief)[1]


def certain() -> torch.Tensor:
    return torch.zeros(6, 6, dtype=torch.float64)


def test_false_alarms_are_as_rare_as_three_sigma_says():
    room = {"room": recordings.room()["room"]}
    error = torch.zeros(6, dtype=torch.float64)
    job = recordings.hand_held(recordings.sensor(sigma=0.02), [EYE] * 12, error=error, real=room)
    job = replace(job, world=recordings.world_of(room))
    labels = torch.stack([frame.label for frame in compared(job, certain())])
    assert labels.numel() == 12 * 64 * 48
    alarms = int((labels != PixelClass.AGREES).sum())
    # 36,864 pixels at 0.27 %: 99.5 and a standard deviation of 10; four of them.
    assert 60 <= alarms <= 140


def test_sigma_of_a_certain_pose_is_the_sensors():
    (frame,) = compared(wall_job(sigma=0.02), certain())
    torch.testing.assert_close(frame.sigma, torch.full((48, 64), 0.02), rtol=1e-5, atol=0)


def test_sigma_grows_with_the_pose_as_eq_4_says():
    sigmas = torch.tensor([0.3, 0.2, 0.01, 0.02, 0.03, 0.5], dtype=torch.float64)
    (frame,) = compared(wall_job(sigma=0.02), torch.diag(sigmas.square()))
    u, v = pixel_grid(CAMERA, dtype=torch.float64, device=torch.device("cpu"))
    x, y, _ = CAMERA.rays(u, v).unbind(-1)
    # A turn w moves the plane's normal n by -w x n: dz = z w . (n x ray) = z (-y w_x + x w_y).
    variance = 0.02**2 + 0.01**2 + (WALL * y * 0.02) ** 2 + (WALL * x * 0.03) ** 2
    # Single precision, and rays through the middle of a pixel for its mean.
    torch.testing.assert_close(frame.sigma.double(), variance.sqrt(), rtol=1e-3, atol=0)


def test_correlated_errors_count_with_their_sign():
    P = torch.zeros(6, 6, dtype=torch.float64)
    P[2, 2], P[4, 4] = 0.01**2, 0.01**2
    P[2, 4] = P[4, 2] = 0.01**2
    (frame,) = compared(wall_job(sigma=0.02), P)
    u, v = pixel_grid(CAMERA, dtype=torch.float64, device=torch.device("cpu"))
    x = CAMERA.rays(u, v)[..., 0]
    # Fully correlated: dz = (-1 + z x) 0.01.
    variance = 0.02**2 + (0.01 * (WALL * x - 1.0)) ** 2
    torch.testing.assert_close(frame.sigma.double(), variance.sqrt(), rtol=1e-3, atol=0)


def test_sigma_contains_the_drift():
    (frame,) = compared(wall_job(sigma=0.03), certain(), drift_sigma=0.04, drift_pixels=9.0)
    torch.testing.assert_close(frame.sigma, torch.full((48, 64), 0.05), rtol=1e-5, atol=0)


def test_a_comparison_takes_27_bytes_a_pixel():
    (frame,) = compared(wall_job(), certain())
    arrays = [getattr(frame, field.name) for field in fields(frame) if field.name != "name"]
    assert sum(array.element_size() * array.numel() for array in arrays) == 27 * 48 * 64


def test_what_the_model_shows_comes_with_the_comparison():
    job = wall_job()
    job.frames[0].image.range[:4] = torch.nan
    (frame,) = compared(job, certain())
    assert (frame.label[:4] == PixelClass.MISSING).all()
    assert (frame.body == 0).all()
    towards = torch.tensor([0.0, 0.0, -1.0]).expand(48, 64, 3)
    torch.testing.assert_close(frame.normal.float(), towards, atol=1e-3, rtol=0)
    torch.testing.assert_close(frame.predicted, torch.full((48, 64), WALL), atol=1e-5, rtol=0)


def test_a_measurement_beside_the_model_is_unmodelled():
    job = wall_job()
    half = scenes.sheet((-9, -9, WALL), (0, -9, WALL), (0, 9, WALL), (-9, 9, WALL))
    (frame,) = compared(replace(job, world=recordings.world_of({"half": half})), certain())
    column = int(CAMERA.cx)
    assert (frame.label[:, column + 2 :] == PixelClass.UNMODELLED).all()
    assert (frame.label[:, : column - 1] != PixelClass.UNMODELLED).all()
    assert frame.sigma[:, column + 2 :].isnan().all()
    assert (frame.body[:, column + 2 :] == -1).all()


def test_a_beam_half_beside_the_model_is_not_compared():
    """Its mean is of the part that met something, which says nothing of the emptiness beside it."""
    sensor = recordings.sensor(CAMERA, beam=9)
    half = scenes.sheet((-9.0, -9.0, WALL), (0.3, -9.0, WALL), (0.3, 9.0, WALL), (-9.0, 9.0, WALL))
    job = recordings.hand_held(sensor, [EYE], error=torch.zeros(6, dtype=torch.float64))
    measured = recordings.record([half], EYE, sensor)
    job = replace(
        job,
        world=recordings.world_of({"half": half}, complete=True),
        frames=(recordings.frame_of(measured, T_world_sensor=EYE),),
    )
    (frame,) = compared(job, certain())
    label = frame.label
    assert not (label == PixelClass.UNMODELLED).any()
    border = measured.isfinite() & (label == PixelClass.NOT_COMPARED)
    columns = border.any(0).nonzero()[:, 0]
    assert 4 <= len(columns) <= 9  # of a beam of 9 pixels those that are less than 3/4 full
    assert border.all(0)[columns].all()


@pytest.mark.parametrize("alpha", [1.0, 2.0, 3.0, 6.0])
def test_another_alpha_gives_what_a_comparison_with_it_would_have(alpha):
    sensor = recordings.sensor(CAMERA, beam=9)
    half = scenes.sheet((-9.0, -9.0, WALL), (0.3, -9.0, WALL), (0.3, 9.0, WALL), (-9.0, 9.0, WALL))
    job = recordings.hand_held(sensor, [EYE], error=torch.zeros(6, dtype=torch.float64))
    measured = recordings.record([half, scenes.wall(2.0 * WALL)], EYE, sensor)
    measured[10:12] = torch.nan
    measured[20:24, :10] -= 0.5
    frame = recordings.frame_of(measured, T_world_sensor=EYE)
    frame.image.usable[30:32] = False
    job = replace(job, world=recordings.world_of({"half": half}, complete=True), frames=(frame,))
    (expected,) = compared(replace(job, alpha=alpha), certain())
    (found,) = compared(replace(job, alpha=3.5), certain())
    assert len(expected.label.unique()) == 6
    again = reclassified(reclassified(found, 50.0), alpha)
    torch.testing.assert_close(again.label, expected.label, atol=0, rtol=0)


def test_no_alpha_below_zero():
    (frame,) = compared(wall_job(), certain())
    with pytest.raises(ValueError, match="alpha -1"):
        reclassified(frame, -1.0)


def test_a_known_range_error_taken_out_leaves_the_true_ranges_and_the_same_classes():
    (frame,) = compared(wall_job(), certain())
    wrong = replace(
        frame,
        measured=0.02 + 1.01 * frame.measured,
        predicted=0.02 + 1.01 * WALL + 0.0 * frame.predicted,
        sigma=1.01 * frame.sigma,
    )
    found = without_range_error(wrong, 0.02, 0.01)
    torch.testing.assert_close(found.measured, frame.measured)
    torch.testing.assert_close(found.predicted, torch.full((48, 64), WALL), atol=1e-5, rtol=0)
    torch.testing.assert_close(found.sigma, frame.sigma)


def test_a_sigma_that_is_too_small_is_enlarged_by_what_the_residuals_show():
    job = replace(wall_job(sigma=0.06, frames=3), sensor=recordings.sensor(CAMERA, sigma=0.02))
    belief, frames = believed_and_compared(job, certain())
    # The median of 9216 residuals is known to 1.3 %.
    assert belief.sigma_scale == pytest.approx(3.0, rel=0.05)
    expected = torch.full((48, 64), 0.02 * belief.sigma_scale)
    torch.testing.assert_close(frames[0].sigma, expected, rtol=1e-5, atol=0)


def test_what_stands_before_the_model_does_not_enlarge_the_noise():
    job = wall_job(sigma=0.02, frames=3)
    for frame in job.frames:
        frame.image.range[:, :20] -= 0.5  # 31 % of the pixels
    belief, _ = believed_and_compared(job, certain())
    # The median of 6336 residuals is known to 1.5 %; that of all would say 1.6.
    assert belief.sigma_scale == pytest.approx(1.0, abs=0.045)


def test_a_sigma_that_is_too_large_stays():
    job = replace(wall_job(sigma=0.001), sensor=recordings.sensor(CAMERA, sigma=0.02))
    belief, _ = believed_and_compared(job, certain())
    assert belief.sigma_scale == 1.0


@pytest.mark.parametrize("beside", [-0.04, 0.0, 0.04])
@pytest.mark.parametrize("limit", ["near", "far"])
def test_where_noise_decides_what_is_measured_nothing_is_said(limit, beside):
    job = wall_job(sigma=0.02)
    sensor = replace(job.sensor, **{limit: WALL + beside})
    ranges = job.frames[0].image.range
    gated = torch.where((ranges > sensor.near) & (ranges < sensor.far), ranges, torch.nan)
    frame = recordings.frame_of(gated, T_world_sensor=EYE)
    (found,) = compared(replace(job, sensor=sensor, frames=(frame,)), certain())
    assert 0.0 < float(gated.isfinite().double().mean()) < 1.0
    assert bool((found.label == PixelClass.NOT_COMPARED).all())
