import pytest
import torch
from torch.testing import assert_close

from torchcal.geometry import robust
from torchcal.solve.field import SmoothField
from torchcal.solve.image_equations import (
    RobustImage,
    blockwise_scatter,
    normal_equations,
    robust_image,
)

WHITE, DRIFT, PIXELS = 0.001, 0.003, 5.0
NO_CUTOFF = 1e6  # its weights differ from 1 by less than 1e-10


def drift_field(height: int, width: int) -> SmoothField:
    like = torch.zeros((), dtype=torch.float64)
    return SmoothField.of(height, width, sigma=DRIFT, pixels=PIXELS, like=like)


def noise(field: SmoothField, generator: torch.Generator) -> torch.Tensor:
    """One image of drift and white noise (m)."""
    height, width = len(field.rows), len(field.columns)
    count = field.rows.shape[1] * field.columns.shape[1]
    coefficients = torch.randn(count, generator=generator, dtype=torch.float64)
    white = torch.randn(height, width, generator=generator, dtype=torch.float64)
    return field.expand(coefficients / field.precision**0.5) + WHITE * white


def plane(height: int, width: int) -> torch.Tensor:
    """Derivatives of a plane's range to its offset and its tilts."""
    v = torch.linspace(-1, 1, height, dtype=torch.float64)[:, None].expand(height, width)
    u = torch.linspace(-1, 1, width, dtype=torch.float64).expand(height, width)
    return torch.stack([torch.ones_like(u), u, v], -1)


def separate(
    residual: torch.Tensor, field: SmoothField | None, cutoff: float = NO_CUTOFF
) -> RobustImage:
    sigma = torch.full_like(residual, WHITE)
    compared = torch.ones_like(residual, dtype=torch.bool)
    return robust_image(residual, sigma, compared, cutoff=cutoff, field=field)


@pytest.mark.parametrize("with_field", [True, False])
def test_equations_are_those_of_the_full_noise_covariance(with_field, rng):
    shape = (12, 14)
    field = drift_field(*shape) if with_field else None
    sigma = WHITE * (1 + torch.rand(shape, generator=rng, dtype=torch.float64))
    residual = DRIFT * torch.randn(shape, generator=rng, dtype=torch.float64)
    A = torch.cat([plane(*shape), torch.randn(*shape, 2, generator=rng, dtype=torch.float64)], -1)
    C = torch.diag(sigma.flatten().square())
    if field is not None:
        count = field.rows.shape[1] * field.columns.shape[1]
        Phi = field.expand(torch.eye(count, dtype=torch.float64)).flatten(1).mT
        C = C + Phi @ Phi.mT / field.precision
    compared = torch.ones(shape, dtype=torch.bool)
    image = robust_image(residual, sigma, compared, cutoff=NO_CUTOFF, field=field)
    information, gradient = normal_equations(image, A)
    columns, r = A.flatten(0, 1), residual.flatten()
    expected = torch.linalg.solve(C, torch.cat([columns, r[:, None]], 1))
    assert_close(information, columns.mT @ expected[:, :5], rtol=1e-9, atol=1e-6)
    assert_close(gradient, columns.mT @ expected[:, 5], rtol=1e-9, atol=1e-6)
    assert_close(image.cost, 0.5 * r @ expected[:, 5], rtol=1e-9, atol=0)


def test_outliers_get_no_weight_and_no_share_of_the_drift(rng):
    field = drift_field(30, 40)
    clean = noise(field, rng)
    residual = clean.clone()
    residual[10:14, 20:24] = 0.1
    image = separate(residual, field, cutoff=robust.EFFICIENT)
    assert image.precision[10:14, 20:24].eq(0).all()
    others = torch.ones(30, 40, dtype=torch.bool)
    others[10:14, 20:24] = False
    same = robust_image(
        clean, torch.full_like(clean, WHITE), others, cutoff=robust.EFFICIENT, field=field
    )
    assert_close(image.error[others], same.error[others], rtol=0, atol=1e-12)


@pytest.mark.parametrize("cutoff", [NO_CUTOFF, robust.EFFICIENT, 1.0])
def test_the_information_is_symmetric_and_positive(cutoff, rng):
    field = drift_field(20, 24)
    A = torch.cat([plane(20, 24), torch.rand(20, 24, 3, generator=rng, dtype=torch.float64)], -1)
    information, _ = normal_equations(separate(noise(field, rng), field, cutoff), A)
    assert_close(information, information.mT, rtol=0, atol=0)
    assert torch.linalg.eigvalsh(information).gt(0).all()


@pytest.mark.parametrize("with_field", [True, False])
def test_pixels_that_are_not_compared_have_no_influence(with_field, rng):
    field = drift_field(20, 24)
    compared = torch.rand(20, 24, generator=rng) < 0.7
    residual, sigma, A = noise(field, rng), torch.full((20, 24), WHITE).double(), plane(20, 24)

    def results(garbage: float) -> list[torch.Tensor]:
        image = robust_image(
            torch.where(compared, residual, garbage),
            torch.where(compared, sigma, abs(garbage)),
            compared,
            cutoff=robust.EFFICIENT,
            field=field if with_field else None,
        )
        jacobian = torch.where(compared[..., None], A, garbage)
        scatter = blockwise_scatter(image, jacobian, 6)
        return [image.cost, *normal_equations(image, jacobian), scatter]

    for first, second in zip(results(1e30), results(-7.0), strict=True):
        assert_close(first, second, rtol=0, atol=0)


def nees(field: SmoothField, modelled: bool, steps: int, cutoff: float) -> float:
    """Mean squared error of a plane over its claimed variance, per parameter; truth 0."""
    A = plane(len(field.rows), len(field.columns))
    total = 0.0
    for seed in range(200):
        measured = noise(field, torch.Generator().manual_seed(seed))
        estimate, information = torch.zeros(3).double(), torch.zeros(3, 3).double()
        for _ in range(steps):
            image = separate(measured - A @ estimate, field if modelled else None, cutoff)
            information, gradient = normal_equations(image, A)
            estimate = estimate + torch.linalg.solve(information, gradient)
        total += float(estimate @ information @ estimate) / 3
    return total / 200


@pytest.mark.parametrize(("steps", "cutoff"), [(1, NO_CUTOFF), (2, robust.EFFICIENT)])
def test_errors_are_as_large_as_claimed_when_the_drift_is_modelled(steps, cutoff):
    # 600 squared errors scatter by sqrt(2 / 600) = 6 %.
    assert 0.85 < nees(drift_field(20, 24), True, steps, cutoff) < 1.15


def test_errors_are_much_larger_than_claimed_when_it_is_not():
    assert nees(drift_field(20, 24), False, 1, NO_CUTOFF) > 3


def shares(field: SmoothField, modelled: bool) -> torch.Tensor:
    """Eigenvalues of scatter over information, for a plane and the edges of a step."""
    height, width = len(field.rows), len(field.columns)
    A = torch.cat([plane(height, width), (plane(height, width)[..., 1:] > 0.1).double()], -1)
    information = scatter = torch.zeros(5, 5, dtype=torch.float64)
    for seed in range(200):
        measured = noise(field, torch.Generator().manual_seed(seed))
        image = separate(measured, field if modelled else None)
        information = information + normal_equations(image, A)[0]
        scatter = scatter + blockwise_scatter(image, A, 12)
    return torch.linalg.eigvals(torch.linalg.solve(information, scatter)).real


def test_blocks_scatter_as_the_information_says_for_right_noise():
    # Some of the pixels' freedom is used up by the drift's coefficients, which lowers the scatter.
    ratio = shares(drift_field(36, 36), True)
    assert 0.7 < float(ratio.min())
    assert float(ratio.max()) < 1.2


def test_blocks_scatter_more_than_the_information_says_for_wrong_noise():
    assert float(shares(drift_field(36, 36), False).min()) > 3
