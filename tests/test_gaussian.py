import math

import torch
from torch.testing import assert_close

from torchcal.geometry import gaussian


def spread(*rows: list[float]) -> torch.Tensor:
    return torch.tensor(rows, dtype=torch.float64)


def test_predicted_sigma_by_hand():
    H = spread([1.0, 0.0], [1.0, 1.0], [1.0, -1.0])
    P = spread([4.0, 1.0], [1.0, 3.0])
    sigma = torch.tensor([0.0, 4.0, 2.0], dtype=torch.float64)
    expected = torch.tensor([2.0, 5.0, 3.0], dtype=torch.float64)
    assert_close(gaussian.predicted_sigma(H, P, sigma), expected)


def test_predicted_sigma_is_the_scatter_of_measured_minus_predicted(rng):
    root = torch.randn(3, 3, generator=rng, dtype=torch.float64)
    H = torch.randn(2, 2, 3, generator=rng, dtype=torch.float64)
    sigma = torch.rand(2, 2, generator=rng, dtype=torch.float64)
    errors = torch.randn(40_000, 3, generator=rng, dtype=torch.float64) @ root.mT
    noise = sigma * torch.randn(40_000, 2, 2, generator=rng, dtype=torch.float64)
    drawn = torch.einsum("hwp,np->nhw", H, errors) + noise
    # A standard deviation of 40,000 draws scatters by 0.35 %.
    assert_close(
        gaussian.predicted_sigma(H, root @ root.mT, sigma), drawn.std(0), rtol=0.015, atol=0
    )


def test_a_known_parameter_adds_nothing():
    sigma = torch.full((4, 5), 0.05, dtype=torch.float64)
    H = torch.ones(4, 5, 2, dtype=torch.float64)
    nothing = torch.zeros(2, 2, dtype=torch.float64)
    assert_close(gaussian.predicted_sigma(H, nothing, sigma), sigma)


def test_moved_covariance_is_the_scatter_of_what_moves(rng):
    J = torch.randn(2, 6, 2, generator=rng, dtype=torch.float64)
    P = spread([2.0, 0.5], [0.5, 1.0])
    moved = gaussian.moved_covariance(P, J)
    a, b = J[1, 3], J[1, 5]
    by_hand = 2 * a[0] * b[0] + 0.5 * (a[0] * b[1] + a[1] * b[0]) + a[1] * b[1]
    assert_close(moved[1, 3, 5], by_hand)
    assert_close(moved, moved.mT)


def test_without_data_all_of_the_prior_is_left():
    prior = torch.tensor([0.1, 0.02, 3.0], dtype=torch.float64)
    ratio, _ = gaussian.left_over(torch.diag(prior.square()), prior)
    assert_close(ratio, torch.ones(3, dtype=torch.float64))


def test_strong_data_leave_next_to_nothing():
    prior = torch.tensor([0.1, 0.02], dtype=torch.float64)
    ratio, _ = gaussian.left_over(torch.diag((1e-4 * prior).square()), prior)
    assert_close(ratio, torch.full((2,), 1e-4, dtype=torch.float64))


def test_a_direction_between_parameters_that_no_data_told_is_found():
    prior = torch.tensor([0.1, 0.02], dtype=torch.float64)
    unit = torch.tensor([1.0, -1.0], dtype=torch.float64) / math.sqrt(2)
    told = torch.tensor([1.0, 1.0], dtype=torch.float64) / math.sqrt(2)
    scaled = torch.outer(unit, unit) + 0.01 * torch.outer(told, told)
    ratio, direction = gaussian.left_over(scaled * prior[:, None] * prior, prior)
    assert_close(ratio, torch.tensor([1.0, 0.1], dtype=torch.float64))
    assert_close((direction.mT @ unit).abs(), torch.tensor([1.0, 0.0], dtype=torch.float64))


def test_rounding_below_zero_is_zero():
    ratio, _ = gaussian.left_over(spread([1.0, 0.0], [0.0, -1e-18]), spread([1.0, 1.0])[0])
    assert_close(ratio, torch.tensor([1.0, 0.0], dtype=torch.float64), rtol=0, atol=0)


def test_a_covariance_that_is_not_finite_leaves_nan():
    bad = torch.full((2, 2), torch.nan, dtype=torch.float64)
    assert gaussian.left_over(bad, spread([1.0, 1.0])[0])[0].isnan().all()
