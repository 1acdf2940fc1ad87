"""Block means against plain loops, and which pixels the estimate is given."""

from dataclasses import replace
from pathlib import Path

import pytest
import recordings
import torch
from recordings import CAMERA, EYE, NO_DRIFT
from torch import Tensor

from torchcal.calibrate.observation import MASK_MARGIN, Observation, coarser, grown, observe
from torchcal.geometry.projection import Pinhole
from torchcal.model.job import Job
from torchcal.model.sensor import Noise, Sensor

FINE = Pinhole(width=64, height=48, fx=600.0, fy=600.0, cx=31.5, cy=23.5)
"""The pixels of a usual depth camera, so that a slope is not a jump."""
EDGE = 20
"""First column of the far side in ``step_image``."""


def job_of(
    image: Tensor,
    *,
    usable: Tensor | None = None,
    beam: int = 1,
    far: float = 10.0,
    lens: Pinhole = FINE,
) -> Job:
    noise = Noise(a=0.001, b=0.002, drift=NO_DRIFT)
    return Job(
        file=Path("job.toml"),
        world=recordings.world_of(recordings.room()),
        robot=None,
        sensor=Sensor(projection=lens, noise=noise, near=0.1, far=far, beam=beam),
        link=None,
        T_world_base=EYE,
        T_link_sensor=EYE,
        frames=(recordings.frame_of(image, usable=usable, T_world_sensor=EYE),),
        base=None,
        mount=None,
    )


def step_image() -> Tensor:
    """A wall at 1 m, and 1.5 m from column ``EDGE`` on."""
    image = torch.ones(48, 64, dtype=torch.float64)
    image[:, EDGE:] = 1.5
    return image


def random_observation(rng: torch.Generator) -> Observation:
    ranges = 1.0 + torch.rand(2, 7, 11, generator=rng, dtype=torch.float64)
    measured = torch.rand(2, 7, 11, generator=rng) > 0.4
    sigma = 0.01 * (1.0 + torch.rand(2, 7, 11, generator=rng, dtype=torch.float64))
    projection = Pinhole(width=11, height=7, fx=9.0, fy=8.0, cx=5.0, cy=3.0)
    return Observation(
        sensor=Sensor(projection=projection, noise=Noise(a=0.01), near=0.1, far=9.0, beam=1),
        range=torch.where(measured, ranges, 0.0),
        measured=measured,
        sigma=sigma,
    )


def test_block_means_are_those_of_a_plain_loop(rng):
    fine = random_observation(rng)
    found = coarser(fine, 3)
    assert found.range.shape == (2, 2, 3)
    for k in range(2):
        for row in range(2):
            for column in range(3):
                block = (k, slice(3 * row, 3 * row + 3), slice(3 * column, 3 * column + 3))
                seen = fine.measured[block]
                assert bool(found.measured[k, row, column]) == (int(seen.sum()) >= 5)
                if found.measured[k, row, column]:
                    mean = fine.range[block][seen].mean()
                    sigma = fine.sigma[block][seen].mean() / 3.0
                    torch.testing.assert_close(found.range[k, row, column], mean)
                    torch.testing.assert_close(found.sigma[k, row, column], sigma)
                else:
                    assert found.range[k, row, column] == 0.0


def test_a_block_looks_along_the_mean_of_its_pixels():
    fine = Pinhole(width=12, height=8, fx=9.0, fy=8.0, cx=5.3, cy=3.1)
    coarse = fine.resized(4)
    u, v = torch.meshgrid(torch.arange(4.0, 8.0), torch.arange(0.0, 4.0), indexing="xy")
    mean = fine.rays(u, v).mean((0, 1))
    found = coarse.rays(torch.tensor(1.0), torch.tensor(0.0))
    torch.testing.assert_close(found, mean)


def test_factor_one_changes_nothing(rng):
    fine = random_observation(rng)
    assert coarser(fine, 1) is fine


@pytest.mark.parametrize(
    ("beam", "factor", "expected"), [(0, 4, 0), (1, 4, 1), (21, 4, 5), (21, 7, 3), (5, 8, 1)]
)
def test_the_beam_of_coarser_pixels_is_the_nearest_odd_one(beam, factor, expected):
    image = torch.ones(48, 64, dtype=torch.float64)
    assert coarser(observe(job_of(image, beam=beam)), factor).sensor.beam == expected


def test_pixels_within_two_of_a_jump_are_left_out_for_sharp_sensors():
    observation = observe(job_of(step_image()))
    beside = torch.zeros(48, 64, dtype=torch.bool)
    beside[:, EDGE - 2 : EDGE + 2] = True
    torch.testing.assert_close(observation.measured[0], ~beside)


def test_jumps_stay_in_for_wide_beams():
    assert observe(job_of(step_image(), beam=3)).measured.all()


def test_a_step_within_the_noise_is_not_a_jump():
    noise = 0.02 * torch.randn(
        48, 64, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    job = job_of(9.0 + noise)
    # sigma(9 m) = 0.019 m; of 3072 windows of nine none spans six of them and 2 % of 9 m.
    assert observe(job).measured.all()


def test_a_slanted_wall_is_not_a_jump():
    u = torch.arange(64, dtype=torch.float64).expand(48, 64)
    # 60 degrees off its normal: z = 2 / (1 - tan(60) x).
    image = 2.0 / (1.0 - 3.0**0.5 * (u - FINE.cx) / FINE.fx)
    assert observe(job_of(image)).measured.all()


def test_a_slanted_wall_is_not_a_jump_for_a_coarse_sensor_either():
    u = torch.arange(64, dtype=torch.float64).expand(48, 64)
    image = 2.0 / (1.0 - 3.0**0.5 * (u - CAMERA.cx) / (4.0 * CAMERA.fx))
    job = job_of(image)
    coarse = replace(CAMERA, fx=4.0 * CAMERA.fx, fy=4.0 * CAMERA.fy)
    assert observe(replace(job, sensor=replace(job.sensor, projection=coarse))).measured.all()


def test_masked_and_missing_pixels_are_not_measured():
    image = torch.ones(48, 64, dtype=torch.float64)
    image[0, 0] = torch.nan
    usable = torch.ones(48, 64, dtype=torch.bool)
    usable[:, 40:] = False
    wide = observe(job_of(image, usable=usable, beam=3))
    expected = usable.clone()
    expected[0, 0] = False
    assert torch.equal(wide.measured[0], expected)
    sharp = observe(job_of(image, usable=usable))
    expected[:, 40 - MASK_MARGIN :] = False
    assert torch.equal(sharp.measured[0], expected)
    assert (sharp.range[0][~expected] == 0.0).all()
    assert sharp.sigma.isfinite().all()


def test_sigma_is_the_sensors_at_the_measured_range():
    observation = observe(job_of(step_image()))
    torch.testing.assert_close(observation.sigma[0, 0, 0].item(), 0.003, rtol=1e-6, atol=0)
    torch.testing.assert_close(observation.sigma[0, 0, -1].item(), 0.004, rtol=1e-6, atol=0)


def test_the_images_dtype_is_chosen():
    assert observe(job_of(step_image())).range.dtype == torch.float32
    assert observe(job_of(step_image()), dtype=torch.float64).range.dtype == torch.float64


def test_without_takes_pixels_away():
    observation = observe(job_of(torch.ones(48, 64, dtype=torch.float64)))
    excluded = torch.zeros(1, 48, 64, dtype=torch.bool)
    excluded[:, :5] = True
    assert torch.equal(observation.without(excluded).measured, ~excluded)


@pytest.mark.parametrize("pixels", [0, 1, 2, 3, 5, 8, 40])
def test_masks_grow_by_a_square(rng, pixels):
    mask = torch.rand(2, 9, 17, generator=rng) < 0.03
    near = (mask.nonzero()[:, None] - torch.ones_like(mask).nonzero()).abs()
    within = (near[..., 0] == 0) & (near[..., 1:].amax(-1) <= pixels)
    before = mask.clone()
    torch.testing.assert_close(grown(mask, pixels), within.any(0).view(mask.shape))
    torch.testing.assert_close(mask, before)


@pytest.mark.parametrize("shape", [(1, 1), (1, 8), (8, 1), (2, 2)])
def test_images_of_a_pixel_or_a_row_are_observed(shape):
    image = torch.full(shape, 1.0, dtype=torch.float64)
    lens = Pinhole(width=shape[1], height=shape[0], fx=9.0, fy=9.0, cx=0.0, cy=0.0)
    found = observe(job_of(image, lens=lens))
    assert found.range.shape == found.measured.shape == found.sigma.shape == (1, *shape)
    assert found.measured.all()
