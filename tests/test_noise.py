"""Noise with a known split: what its correlation says, and what is made of it."""

import itertools

import numpy as np
import pytest
import torch
from scipy import ndimage

from torchcal.calibrate.noise import LAGS, correlation, noise_model

SHAPE = (240, 320)
SHORTEST = 1.0


def smooth(seed: int, sigma: float, pixels: float) -> np.ndarray:
    """A Gaussian field whose correlation falls to exp(-1/2) at ``pixels``."""
    width = pixels / np.sqrt(2.0)
    white = np.random.default_rng(seed).standard_normal(SHAPE)
    field = ndimage.gaussian_filter(white, width, mode="wrap")
    return sigma * 2.0 * np.sqrt(np.pi) * width * field


def model_of(residuals: list[np.ndarray], counted: np.ndarray | None = None, sigma: float = 0.002):
    mask = torch.ones(SHAPE, dtype=torch.bool) if counted is None else torch.from_numpy(counted)
    pairs = [(torch.from_numpy(residual), mask) for residual in residuals]
    return noise_model(correlation(pairs), sigma, shortest=SHORTEST)


def white(seed: int, sigma: float) -> np.ndarray:
    return sigma * np.random.default_rng(seed).standard_normal(SHAPE)


def test_correlation_is_that_of_a_double_loop():
    random = np.random.default_rng(0)
    residual, counted = random.standard_normal((6, 9)), random.random((6, 9)) > 0.3
    total, pairs = np.zeros(LAGS + 1), np.zeros(LAGS + 1)
    pixels = list(itertools.product(range(6), range(9)))
    for a, b in itertools.product(pixels, pixels):
        if counted[a] and counted[b]:
            lag = round(np.hypot(a[0] - b[0], a[1] - b[1]))
            total[lag] += residual[a] * residual[b]
            pairs[lag] += 1
    expected = total / np.maximum(pairs, 1)
    found = correlation([(torch.from_numpy(residual), torch.from_numpy(counted))])
    # Rounding of a Fourier transform of 10,000 numbers of size 1.
    np.testing.assert_allclose(found[pairs > 0], expected[pairs > 0], atol=1e-12)


def test_correlation_weighs_frames_by_their_pairs():
    one, half = torch.ones(8, 8, dtype=torch.bool), torch.zeros(8, 8, dtype=torch.bool)
    half[:4] = True
    found = correlation([(torch.full((8, 8), 1.0), one), (torch.full((8, 8), 3.0), half)])
    np.testing.assert_allclose(found[0], (64 * 1.0 + 32 * 9.0) / 96, rtol=1e-12)


def test_pixels_that_do_not_count_leave_no_trace():
    residual, mask = torch.ones(8, 8), torch.ones(8, 8, dtype=torch.bool)
    mask[2, 3] = False
    outlier = residual.clone()
    outlier[2, 3] = 1e6
    np.testing.assert_allclose(correlation([(outlier, mask)])[:8], 1.0, rtol=1e-9)


@pytest.mark.parametrize("pixels", [8.0, 15.0, 30.0])
def test_white_and_smooth_noise_are_told_apart(pixels):
    residuals = [white(s, 0.002) + smooth(s + 100, 0.003, pixels) for s in range(6)]
    found = model_of(residuals)
    # At 30 pixels six images hold only some 6 * 85 independent patches: 5 % of the smooth part's
    # sigma; its length depends on the tail of the correlation, which is worse known.
    assert found.drift.sigma == pytest.approx(0.003, rel=0.1)
    assert found.drift.pixels == pytest.approx(pixels, rel=0.2)
    assert found.sigma_scale == pytest.approx(1.0, rel=0.1)


def test_a_mask_does_not_change_the_split():
    counted = np.random.default_rng(5).random(SHAPE) > 0.5
    residuals = [white(s, 0.002) + smooth(s + 100, 0.003, 15.0) for s in range(4)]
    found = model_of(residuals, counted)
    # Half of the pixels are a quarter of the pairs, still far more than the smooth patches.
    assert found.drift.sigma == pytest.approx(0.003, rel=0.1)
    assert found.drift.pixels == pytest.approx(15.0, rel=0.2)


def test_white_noise_has_no_slowly_varying_part():
    found = model_of([white(s, 0.002) for s in range(4)])
    assert found.drift.sigma == 0.0
    # 300,000 pixels: 0.13 % of the standard deviation.
    assert found.sigma_scale == pytest.approx(1.0, rel=0.01)


def test_sigma_scale_says_how_much_noisier_the_sensor_is():
    found = model_of([white(s, 0.006) for s in range(2)])
    assert found.sigma_scale == pytest.approx(3.0, rel=0.01)


def test_length_is_not_shorter_than_what_can_be_represented():
    residuals = [white(s, 0.002) + smooth(s + 100, 0.003, 8.0) for s in range(2)]
    pairs = [(torch.from_numpy(residual), torch.ones(SHAPE).bool()) for residual in residuals]
    assert noise_model(correlation(pairs), 0.002, shortest=25.0).drift.pixels == 25.0
