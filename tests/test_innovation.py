"""An expectation and an image, joined as Gaussians are, against the formulas of the textbook."""

import math

import pytest
import torch
from scipy.stats import chi2

from torchcal.calibrate.innovation import innovation


def draws(count: int) -> torch.Tensor:
    return torch.randn(6, count, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def test_both_are_joined_by_their_informations():
    A, B = draws(9), draws(8)
    P, information = A @ A.mT, B @ B.mT
    score = draws(1)[:, 0]
    joined = innovation(P, information, score, P.diagonal().sqrt())
    expected = torch.linalg.inv(torch.linalg.inv(P) + information)
    torch.testing.assert_close(joined.covariance, expected)
    torch.testing.assert_close(joined.step, expected @ score)


def test_the_p_value_is_that_of_the_two_estimates():
    A, B = draws(9), draws(8)
    P, information = A @ A.mT, B @ B.mT
    apart = 2.0 * draws(1)[:, 0]  # of the image's own estimate from the expected state
    joined = innovation(P, information, information @ apart, P.diagonal().sqrt())
    distance = float(apart @ torch.linalg.solve(P + torch.linalg.inv(information), apart))
    assert joined.p_value == pytest.approx(chi2.sf(distance, 6), rel=1e-9)


def test_only_directions_that_the_image_tells_count():
    P = torch.diag(torch.tensor([1.0, 4.0, 9.0]).double())
    information = torch.zeros(3, 3).double()
    information[1, 1] = 0.5
    joined = innovation(P, information, torch.tensor([0.0, 1.5, 0.0]).double(), P.diagonal().sqrt())
    # The image alone says 3 with variance 2, expected was 0 with variance 4.
    assert joined.p_value == pytest.approx(chi2.sf(9.0 / 6.0, 1), rel=1e-12)
    torch.testing.assert_close(joined.step, torch.tensor([0.0, 2.0, 0.0]).double())
    variances = torch.tensor([1.0, 4.0 / 3.0, 9.0]).double()
    torch.testing.assert_close(joined.covariance, torch.diag(variances))


def test_an_image_that_tells_nothing_changes_nothing():
    P = torch.diag(torch.tensor([1e-6, 4.0]).double())
    joined = innovation(P, torch.zeros(2, 2).double(), torch.zeros(2).double(), P.diagonal().sqrt())
    assert joined.p_value == 1.0
    torch.testing.assert_close(joined.covariance, P)


@pytest.mark.parametrize("sigma", [1e-9, 1e-6, 1e-3, 10.0])
def test_what_is_known_well_can_still_be_contradicted(sigma):
    P = torch.diag(torch.tensor([sigma, sigma / 10.0]).double().square())
    information = torch.diag(torch.tensor([1e6, 0.0]).double())  # sigmas of a millimetre
    apart = 5.0 * math.hypot(sigma, 1e-3)
    score = information @ torch.tensor([apart, 0.0]).double()
    joined = innovation(P, information, score, (P.diagonal() + 0.03**2).sqrt())
    assert joined.p_value == pytest.approx(chi2.sf(25.0, 1), rel=1e-6)
    variances = torch.tensor([1.0 / (1e6 + sigma**-2), sigma**2 / 100.0]).double()
    torch.testing.assert_close(joined.covariance, torch.diag(variances))
