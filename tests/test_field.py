import math

import pytest
import torch
from torch.testing import assert_close

from torchcal.solve.field import SmoothField, _gram

SIGMA, PIXELS = 0.003, 4.0
LIKE = torch.zeros((), dtype=torch.float64)


def field(height: int, width: int, pixels: float = PIXELS) -> SmoothField:
    return SmoothField.of(height, width, sigma=SIGMA, pixels=pixels, like=LIKE)


def dense(of: SmoothField) -> torch.Tensor:
    """Phi, from the fields of unit vectors."""
    count = of.rows.shape[1] * of.columns.shape[1]
    return of.expand(torch.eye(count, dtype=torch.float64)).flatten(1).mT


def weights(height: int, width: int) -> torch.Tensor:
    """Precisions (1/m^2) of a sensor with a sigma of about a millimetre."""
    generator = torch.Generator().manual_seed(0)
    return 1e6 * torch.rand((height, width), generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("shape", [(12, 14), (1, 1), (2, 31), (40, 7)], ids=str)
@pytest.mark.parametrize("pixels", [1.0, 4.0, 300.0])
def test_the_splines_sum_to_one(shape, pixels):
    of = field(*shape, pixels=pixels)
    ones = torch.ones(of.rows.shape[1] * of.columns.shape[1], dtype=torch.float64)
    assert_close(of.expand(ones), torch.ones(*shape, dtype=torch.float64))


def test_project_is_the_transpose_of_expand(rng):
    of = field(12, 14)
    images = torch.randn(2, 3, 12, 14, generator=rng, dtype=torch.float64)
    assert_close(of.project(images), images.flatten(-2) @ dense(of))


@pytest.mark.parametrize("shape", [(12, 14), (1, 9), (30, 3)], ids=str)
def test_gram_is_that_of_dense_matrices(shape):
    of, W = field(*shape), weights(*shape)
    Phi = dense(of)
    expected = Phi.mT @ (W.flatten()[:, None] * Phi)
    # Sums in another order; elements of size 1e6.
    assert_close(_gram(of.rows, of.columns, W), expected, rtol=1e-12, atol=1e-7)


@pytest.mark.parametrize("seen", ["all", "corner", "specks", "none"])
def test_solve_is_that_of_the_dense_system(seen, rng):
    of, W = field(24, 30), weights(24, 30)
    mask = {
        "all": torch.ones(24, 30),
        "corner": torch.nn.functional.pad(torch.ones(5, 6), (0, 24, 0, 19)),
        "specks": (torch.rand(24, 30, generator=rng) < 0.02).float(),
        "none": torch.zeros(24, 30),
    }[seen].double()
    W = W * mask
    Phi = dense(of)
    system = Phi.mT @ (W.flatten()[:, None] * Phi)
    system = system + of.precision * torch.eye(len(system), dtype=torch.float64)
    right = of.project(W * torch.randn(3, 24, 30, generator=rng, dtype=torch.float64))
    expected = torch.linalg.solve(system, right.mT).mT
    # Coefficients below a share of 1e-9 of the prior are left at 0: sqrt(1e-9) of their size.
    assert_close(of.system(W).solve(right), expected, rtol=1e-5, atol=2e-4)


def test_only_coefficients_near_a_seen_pixel_are_solved_for():
    of = field(24, 30)
    W = torch.zeros(24, 30, dtype=torch.float64)
    W[3, 4] = 1e6
    assert len(of.system(W).told) == 16


def test_peaks_are_where_each_spline_is_largest():
    of = field(24, 30)
    v, u = of.peaks()
    images = dense(of).mT.unflatten(-1, (24, 30)).unflatten(0, (len(v), len(u)))
    assert_close(images[2, 3, v[2], u[3]], images[2, 3].max(), rtol=0, atol=0)


def test_variance_and_correlation_of_the_model_are_those_asked_for():
    of = field(64, 64)
    Phi = dense(of)
    covariance = (Phi @ Phi.mT / of.precision).view(64, 64, 64, 64)
    inner = range(16, 48)
    variance = sum(covariance[i, j, i, j] for i in inner for j in inner) / len(inner) ** 2
    lagged = sum(covariance[i, j, i, j + 4] for i in inner for j in inner) / len(inner) ** 2
    # The mean over a few cells of the grid instead of whole ones; B-splines for a Gaussian.
    assert math.sqrt(variance) == pytest.approx(SIGMA, rel=0.01)
    assert float(lagged / variance) == pytest.approx(math.exp(-0.5), rel=0.05)


def test_sampled_fields_have_the_variance_and_correlation_asked_for(rng):
    of = field(60, 80)
    shape = (100, of.rows.shape[1] * of.columns.shape[1])
    drawn = torch.randn(shape, generator=rng, dtype=torch.float64) / of.precision**0.5
    images = of.expand(drawn)
    lag = int(PIXELS)
    along_v = (images[:, lag:] * images[:, :-lag]).mean()
    along_u = (images[:, :, lag:] * images[:, :, :-lag]).mean()
    # 100 images of about 200 independent cells scatter by 1 %; the rest is the splines' shape.
    assert float(images.std()) == pytest.approx(SIGMA, rel=0.1)
    for product in (along_v, along_u):
        assert float(product / images.var()) == pytest.approx(math.exp(-0.5), rel=0.1)
