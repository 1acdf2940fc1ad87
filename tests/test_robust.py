from collections.abc import Callable

import pytest
import torch
from scipy.integrate import quad
from scipy.stats import norm
from torch.testing import assert_close

from torchcal.geometry import robust

C = 4.685
RESIDUALS = torch.linspace(-7.0, 7.0, 281, dtype=torch.float64)


def test_the_slope_of_the_cost_is_the_weighted_residual():
    v = RESIDUALS.clone().requires_grad_()
    (slope,) = torch.autograd.grad(robust.biweight_cost(v, C).sum(), v)
    assert_close(slope, RESIDUALS * robust.biweight(RESIDUALS, C))


def test_weight_by_hand():
    v = torch.tensor([0.0, 1.0, 2.0, 3.0], dtype=torch.float64)
    expected = torch.tensor([1.0, 0.5625, 0.0, 0.0], dtype=torch.float64)
    assert_close(robust.biweight(v, 2.0), expected, rtol=0, atol=0)


def test_cost_is_flat_at_a_sixth_of_the_squared_cutoff_from_the_cutoff_on():
    v = torch.tensor([C, -C, 10 * C, torch.inf], dtype=torch.float64)
    assert_close(robust.biweight_cost(v, C), torch.full_like(v, C**2 / 6))
    assert robust.biweight(v, C).eq(0).all()


def test_cost_and_weight_do_not_jump_at_the_cutoff():
    v = torch.tensor([C - 1e-7, C + 1e-7], dtype=torch.float64)
    # The slopes are 0 there, so what is left is of second order.
    assert float(robust.biweight_cost(v, C).diff().abs()) < 1e-12
    assert float(robust.biweight(v, C).diff().abs()) < 1e-12


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_small_residuals_cost_half_their_square(dtype):
    v = torch.tensor([1e-3, -1e-2, 0.0], dtype=dtype)
    # The next term is v^2 / c^2 = 4.6e-6 of it.
    assert_close(robust.biweight_cost(v, C), 0.5 * v.square(), rtol=1e-5, atol=0)


def test_every_residual_may_have_a_cutoff_of_its_own():
    v = torch.tensor([[1.0, 3.0], [1.0, 3.0]], dtype=torch.float64)
    c = torch.tensor([[2.0], [4.0]], dtype=torch.float64)
    for f in (robust.biweight, robust.biweight_cost):
        assert_close(f(v, c), torch.stack([f(v[0], 2.0), f(v[1], 4.0)]), rtol=0, atol=0)


def test_cutoff_is_three_medians():
    v = torch.tensor([-9.0, 1.0, 2.0, -3.0, 8.0], dtype=torch.float64)
    assert float(robust.cutoff(v)) == 9.0
    assert float(robust.cutoff(v, zeta=2.0)) == 6.0


def test_cutoff_is_not_below_the_least():
    v = torch.tensor([0.1, 0.2], dtype=torch.float64)
    assert float(robust.cutoff(v)) == robust.EFFICIENT
    assert float(robust.cutoff(v, least=0.0)) == pytest.approx(0.3)
    assert float(robust.cutoff(v[:0])) == robust.EFFICIENT


def test_every_member_of_a_batch_has_the_cutoff_of_what_is_not_missing():
    v = torch.tensor([[-9.0, 1.0, 2.0], [4.0, torch.nan, torch.nan], [torch.nan] * 3])
    assert robust.cutoff(v, least=1.0).tolist() == [6.0, 12.0, 1.0]
    assert robust.cutoff(v[:, :0], least=1.0).tolist() == [1.0] * 3


def test_what_is_rejected_costs_a_sixth_of_the_squared_cutoff():
    assert robust.rejected_cost(3.0) == 1.5
    beyond = robust.biweight_cost(torch.tensor([3.0, -7.0], dtype=torch.float64), 3.0)
    assert beyond.tolist() == [1.5, 1.5]


def test_efficient_cutoff_keeps_95_percent_of_the_efficiency():
    v = torch.linspace(-9.0, 9.0, 20001, dtype=torch.float64, requires_grad=True)
    psi = v * robust.biweight(v, robust.EFFICIENT)
    (slope,) = torch.autograd.grad(psi.sum(), v)
    psi, v = psi.detach(), v.detach()
    density = torch.exp(-0.5 * v.square())
    density = density / density.sum()
    efficiency = (slope * density).sum().square() / (psi.square() * density).sum()
    assert float(efficiency) == pytest.approx(0.95, abs=1e-4)


def test_scale_of_gaussian_residuals_is_their_standard_deviation(rng):
    v = 3.0 * torch.randn(40_000, generator=rng, dtype=torch.float64)
    v[:2000] = 1e6
    # The median of 40,000 scatters by 0.6 %; 5 % of outliers shift it by 7 %.
    assert robust.robust_scale(v[2000:]) == pytest.approx(3.0, rel=0.025)
    assert robust.robust_scale(v) == pytest.approx(3.0 * 1.066, rel=0.025)
    assert robust.robust_scale(v[:0]) == 1.0


@pytest.mark.parametrize("others", [0.0, 0.05, 0.2, 0.4])
@pytest.mark.parametrize("limit", [1.5, robust.INLIER, 3.0])
def test_scale_of_inliers_is_that_of_the_noise_whatever_stands_beside_it(rng, others, limit):
    v = 3.0 * torch.randn(200_000, generator=rng, dtype=torch.float64)
    count = int(others * len(v))
    # Something new, nearer than the model by 5 to 60 sigma.
    v[:count] = -15.0 - 165.0 * torch.rand(count, generator=rng, dtype=torch.float64)
    # The median of the noise within the limit scatters by less than 0.5 %; three of these.
    assert robust.inlier_scale(v, limit=limit) == pytest.approx(3.0, rel=0.015)
    if others >= 0.2:
        assert robust.robust_scale(v) > 1.25 * 3.0


def test_scale_of_inliers_where_there_is_nothing_to_tell():
    nothing = torch.zeros(0, dtype=torch.float64)
    assert robust.inlier_scale(nothing) == 1.0
    assert robust.inlier_scale(torch.zeros(9, dtype=torch.float64)) == 0.0


def gaussian_mean(f: Callable[[float], float], c: float) -> float:
    """E[f(v); |v| < c] of a standard Gaussian by numerical quadrature."""
    return quad(lambda v: f(v) * norm.pdf(v), -c, c, epsabs=1e-13, points=[0.0])[0]


@pytest.mark.parametrize("c", [1.0, 2.0, 3.5, robust.EFFICIENT, 8.0, 30.0])
def test_variance_and_curvature_are_those_of_numerical_quadrature(c):
    def weight(v: float) -> float:
        return (1 - (v / c) ** 2) ** 2

    def slope(v: float) -> float:
        return (1 - (v / c) ** 2) * (1 - 5 * (v / c) ** 2)

    squared = gaussian_mean(lambda v: (v * weight(v)) ** 2, c)
    inflation = gaussian_mean(lambda _: 1.0, c) * squared / gaussian_mean(slope, c) ** 2
    curvature = gaussian_mean(slope, c) / gaussian_mean(weight, c)
    limit = torch.tensor([c], dtype=torch.float64)
    # The recursion of the moments loses digits below a cut-off of 1.
    assert float(robust.variance_inflation(limit)) == pytest.approx(inflation, rel=1e-8)
    assert float(robust.relative_curvature(limit)) == pytest.approx(curvature, rel=1e-8)


@pytest.mark.parametrize("c", [2.5, robust.EFFICIENT])
def test_variance_inflation_is_the_scatter_of_robust_means(c, rng):
    v = torch.randn(8000, 150, generator=rng, dtype=torch.float64)
    mean = torch.zeros(8000, 1, dtype=torch.float64)
    for _ in range(30):
        w = robust.biweight(v - mean, c)
        mean = (w * v).sum(1, keepdim=True) / w.sum(1, keepdim=True)
    accepted = ((v - mean).abs() < c).sum(1).double().mean()
    inflation = mean.square().mean() * accepted
    # A variance of 8000 draws scatters by 1.6 %; 150 measurements are near the limit of many.
    found = robust.variance_inflation(torch.tensor(c, dtype=torch.float64))
    assert float(inflation) == pytest.approx(float(found), rel=0.06)


def test_without_a_cutoff_in_reach_nothing_is_inflated():
    c = torch.tensor([1e3, 1e6], dtype=torch.float64)
    assert_close(robust.variance_inflation(c), torch.ones_like(c), rtol=1e-5, atol=0)
    assert robust.variance_inflation(c.float()).dtype == torch.float32
    assert robust.variance_inflation(c[:0]).shape == (0,)
