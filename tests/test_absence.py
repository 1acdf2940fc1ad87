"""Compared without an estimate: pixels are forgiven the wide prior, a missing crate is not."""

import pytest
import recordings
import torch
from recordings import EYE, pose, twist

from torchcal.calibrate.pipeline import calibrate
from torchcal.calibrate.result import Calibration
from torchcal.geometry.projection import Pinhole

CAMERA = Pinhole(width=96, height=72, fx=82.0, fy=82.0, cx=47.5, cy=35.5)
VIEWS = [EYE, pose(0.5, 0.1, 0.1, 0.0, -0.15, 0.0)]
OFF = twist(0.06, -0.05, 0.06, 0.05, -0.05, 0.05)
"""0.1 m and 0.087 rad."""


def compared(missing: str | None) -> Calibration:
    real = {name: mesh for name, mesh in recordings.room().items() if name != missing}
    prior = recordings.prior(0.1, 0.087)
    job = recordings.hand_held(recordings.sensor(CAMERA), VIEWS, error=OFF, base=prior, real=real)
    return calibrate(job, estimate=False, generator=torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def as_modelled() -> Calibration:
    return compared(None)


def share_outside(calibration: Calibration, *, with_prior: bool) -> float:
    """Of the pixels, by eq. 5 or by eq. 1."""
    outside = []
    for frame in calibration.comparisons:
        difference = (frame.measured - frame.predicted).abs()
        sigma = frame.sigma if with_prior else calibration.job.sensor.noise.sigma(frame.predicted)
        outside.append((difference > calibration.job.alpha * sigma)[difference.isfinite()])
    return float(torch.cat(outside).double().mean())


def test_eq_1_flags_much_of_the_image_and_eq_5_hardly_a_pixel(as_modelled):
    assert share_outside(as_modelled, with_prior=False) > 0.5
    assert share_outside(as_modelled, with_prior=True) < 0.005


def test_nobody_is_accused_because_the_pose_is_unknown(as_modelled):
    verdicts = {each.verdict for each in as_modelled.update.verdicts.values()}
    assert verdicts <= {"agrees", "unseen"}


@pytest.mark.parametrize("missing", ["crate", "beam"])
def test_what_is_gone_is_removed_although_the_pose_is_unknown(missing):
    verdicts = compared(missing).update.verdicts
    removed = [name for name, each in verdicts.items() if each.verdict == "removed"]
    assert removed == [missing]
    assert verdicts[missing].seen_through > 30
