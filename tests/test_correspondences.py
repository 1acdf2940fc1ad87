import dataclasses

import pytest
import torch
from drawn_elements import (
    covariances,
    elements,
    moved,
    noisy,
    normal,
    one_to_one,
    poses,
    residuals_of,
    retract,
    single,
    units,
    with_covariance,
)
from torch import Tensor
from torch.testing import assert_close

from torchcal.geometry import robust
from torchcal.match.elements import Elements
from torchcal.match.residuals import PairResiduals
from torchcal.solve.correspondences import RobustCorrespondences
from torchcal.solve.gauss_newton import GaussNewtonConfig, Solution, StopReason, minimise

WORD = "PPPLLEEE"
COUNT = len(WORD)


def constant(v: Tensor, A: Tensor, present: Tensor, cutoff: Tensor) -> RobustCorrespondences:
    """Residuals and derivatives that are the same at every state."""
    return RobustCorrespondences(
        linearise=lambda _, problem: (v[problem], A[problem]), present=present, cutoff=cutoff
    )


def drawn(rng: torch.Generator, problems: int = 6) -> RobustCorrespondences:
    """Problems with padding, of which about every second correspondence is within its cut-off."""
    v, A = 2.0 * normal(problems, 7, 3, rng=rng), normal(problems, 7, 3, 2, rng=rng)
    present = torch.rand(problems, 7, 3, generator=rng) < 0.7
    cutoff = 2.0 + 2.0 * torch.rand(problems, generator=rng, dtype=torch.float64)
    return constant(v, A, present, cutoff)


def everything(own: RobustCorrespondences) -> tuple[Tensor, Tensor]:
    """A state for every problem, and their numbers."""
    return torch.zeros(len(own.cutoff), 2, dtype=torch.float64), torch.arange(len(own.cutoff))


def test_normal_equations_are_those_of_plain_loops(rng):
    own = drawn(rng)
    found = own.evaluate(*everything(own))
    v, A = own.linearise(*everything(own))
    dropped = 0
    for b, c in enumerate(own.cutoff.tolist()):
        cost, information = 0.0, torch.zeros(2, 2, dtype=torch.float64)
        gradient = torch.zeros(2, dtype=torch.float64)
        for i in range(7):
            components = [k for k in range(3) if bool(own.present[b, i, k])]
            if any(abs(float(v[b, i, k])) >= c for k in components):
                cost += len(components) * c**2 / 6
                dropped += 1
                continue
            for k in components:
                size, row = float(v[b, i, k]), A[b, i, k]
                weight = (1 - (size / c) ** 2) ** 2
                cost += c**2 / 6 * (1 - (1 - (size / c) ** 2) ** 3)
                information += weight * torch.outer(row, row)
                gradient += weight * size * row
        assert float(found.cost[b]) == pytest.approx(cost)
        assert_close(found.information[b], information)
        assert_close(found.gradient[b], gradient)
    assert 5 < dropped < 37


def test_one_component_beyond_the_cutoff_drops_all_of_its_correspondence():
    v = torch.tensor([[[0.1, 0.2, 3.1], [0.1, 0.2, 2.9], [0.1, 0.2, -3.1]]], dtype=torch.float64)
    present = torch.ones(1, 3, 3, dtype=torch.bool)
    present[0, 2, 2] = False
    A = torch.ones(1, 3, 3, 1, dtype=torch.float64)
    own = constant(v, A, present, torch.tensor([3.0], dtype=torch.float64))
    expected = robust.biweight(v[0], 3.0)
    weights = own.weights(v)[0]
    assert weights[0].eq(0).all()
    assert_close(weights[1], expected[1])
    assert_close(weights[2, :2], expected[2, :2])
    assert weights[2, 2] == 0


def test_the_gradient_is_the_slope_of_the_cost_where_no_component_crosses(rng):
    model, T = scene(10, rng)
    measured = noisy(with_covariance(moved(T, model), covariances(10, COUNT, rng=rng)), rng=rng)
    own = fit_of(residuals_of(model, measured, one_to_one(10, COUNT)))
    # Some tenths of a millimetre off, so that the cost has a slope.
    start, problem = T @ poses(10, rng=rng, size=1e-3), torch.arange(10)
    found = own.evaluate(start, problem)
    h = 1e-7
    columns = [
        own.evaluate(retract(start, sign * h * axis.expand(10, 6)), problem).cost
        for axis in torch.eye(6, dtype=torch.float64)
        for sign in (-1.0, 1.0)
    ]
    slope = torch.stack(
        [(low - high) / (2 * h) for low, high in zip(columns[::2], columns[1::2], strict=True)], -1
    )
    v, _ = own.linearise(start, problem)
    crossing = ((v.abs() - own.cutoff[:, None, None]).abs() < 1e-3) & own.present
    assert not crossing.any()
    assert own.weights(v).gt(0).sum() > 0.8 * own.present.sum()
    # Rounding of a cost of 50 over 2e-7, beside slopes of thousands.
    assert_close(found.gradient, slope, rtol=1e-5, atol=1e-3)


def scene(problems: int, rng: torch.Generator) -> tuple[Elements, Tensor]:
    point, direction = normal(problems, COUNT, 3, rng=rng), units(problems, COUNT, rng=rng)
    return elements(WORD, point, direction), poses(problems, rng=rng)


def fit_of(residuals: PairResiduals) -> RobustCorrespondences:
    cutoff = torch.full((len(residuals.kind),), robust.EFFICIENT, dtype=residuals.p.dtype)
    return RobustCorrespondences(
        linearise=residuals.linearise, present=residuals.present, cutoff=cutoff
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Fits:
    """Six problems and where they start."""

    model: Elements
    measured: Elements
    candidates: Tensor
    start: Tensor

    @staticmethod
    def drawn(rng: torch.Generator) -> "Fits":
        model, T = scene(6, rng)
        exact = with_covariance(moved(T, model), covariances(6, COUNT, rng=rng))
        return Fits(
            model=model,
            measured=noisy(exact, rng=rng),
            candidates=one_to_one(6, COUNT).clone(),
            start=T @ poses(6, rng=rng, size=3e-3),
        )

    def solved(self, rows: list[int]) -> Solution:
        """By a batch of some of them alone."""
        chosen = torch.tensor(rows)
        own = residuals_of(self.model[chosen], self.measured[chosen], self.candidates[chosen])
        return minimise(fit_of(own).evaluate, retract, self.start[chosen], GaussNewtonConfig())


NAN, SINGULAR, HOPELESS = 1, 2, 4
GOOD = [0, 3, 5]


def spoilt(fits: Fits) -> None:
    """One problem with a NaN, one with a single point, one too far from its start."""
    fits.measured.point[NAN, 2] = torch.nan
    fits.candidates[SINGULAR, 1:] = False
    fits.start[HOPELESS, :3, 3] += 100.0


def test_bad_problems_leave_the_others_bit_for_bit_as_they_were(rng):
    fits = Fits.drawn(rng)
    before = fits.solved(list(range(6)))
    spoilt(fits)
    after = fits.solved(list(range(6)))
    assert before.stop.eq(StopReason.CONVERGED).all()
    for name in ("state", "stop", "iterations"):
        assert_close(getattr(after, name)[GOOD], getattr(before, name)[GOOD], rtol=0, atol=0)
    assert_close(
        after.equations.information[GOOD], before.equations.information[GOOD], rtol=0, atol=0
    )
    assert after.stop[NAN] == StopReason.INVALID
    assert_close(after.state[HOPELESS], fits.start[HOPELESS], rtol=0, atol=0)
    assert after.state[SINGULAR].isfinite().all()


def test_good_problems_do_not_notice_that_the_bad_ones_are_removed(rng):
    fits = Fits.drawn(rng)
    spoilt(fits)
    whole, some = fits.solved(list(range(6))), fits.solved(GOOD)
    assert_close(some.state, whole.state[GOOD], rtol=0, atol=0)
    assert_close(some.equations.cost, whole.equations.cost[GOOD], rtol=0, atol=0)
    assert_close(some.iterations, whole.iterations[GOOD])


def test_the_fit_is_near_the_truth_with_a_third_of_wrong_correspondences(rng):
    model, T = scene(20, rng)
    measured = noisy(with_covariance(moved(T, model), covariances(20, COUNT, rng=rng)), rng=rng)
    C = one_to_one(20, COUNT).clone()
    C[:, 0, 1] = C[:, 1, 2] = C[:, 3, 4] = C[:, 5, 6] = True
    start = T @ poses(20, rng=rng, size=2e-3)
    own = fit_of(residuals_of(model, measured, C))
    found = minimise(own.evaluate, retract, start, GaussNewtonConfig())
    alone = fit_of(residuals_of(model, measured, one_to_one(20, COUNT)))
    right = minimise(alone.evaluate, retract, start, GaussNewtonConfig(tolerance=1e-6))
    # Wrong ones have no weight at all: what is left is where the iteration stops.
    assert_close(found.state, right.state, rtol=0, atol=1e-3)


def test_dtype_follows(rng):
    model, T = scene(3, rng)
    measured = single(with_covariance(moved(T, model), covariances(3, COUNT, rng=rng)))
    own = fit_of(residuals_of(single(model), measured, one_to_one(3, COUNT)))
    found = minimise(own.evaluate, retract, T.float(), GaussNewtonConfig())
    assert found.state.dtype == torch.float32
    equations = found.equations
    for values in (equations.cost, equations.information, equations.gradient):
        assert values.dtype == torch.float32
    # float32 rounds 1e-6 m in units of some mm.
    assert_close(found.state, T.float(), rtol=0, atol=1e-4)


@pytest.mark.parametrize("shape", [(0, 3, 5), (2, 0, 5)], ids=["no problems", "no pairs"])
def test_nothing_to_fit_has_no_cost(shape):
    v = torch.zeros(*shape, dtype=torch.float64)
    c = torch.ones(shape[0], dtype=torch.float64)
    own = constant(v, v[..., None].expand(*shape, 6), v > 0, c)
    T = torch.eye(4, dtype=torch.float64).expand(shape[0], 4, 4)
    found = own.evaluate(T, torch.arange(shape[0]))
    assert found.cost.tolist() == [0.0] * shape[0]
    assert found.information.eq(0).all()
    assert own.weights(v).shape == shape
    solution = minimise(own.evaluate, retract, T, GaussNewtonConfig())
    assert_close(solution.state, T, rtol=0, atol=0)


def test_a_cutoff_that_is_nan_or_zero_concerns_its_own_problem(rng):
    own = drawn(rng)
    expected = own.evaluate(*everything(own))
    own.cutoff[2], own.cutoff[4] = torch.nan, 0.0
    found = own.evaluate(*everything(own))
    kept = [0, 1, 3, 5]
    assert_close(found.cost[kept], expected.cost[kept], rtol=0, atol=0)
    assert_close(found.gradient[kept], expected.gradient[kept], rtol=0, atol=0)
    assert found.cost[2].isnan()
    assert found.cost[4] == 0
    assert found.information[4].eq(0).all()


def test_padding_may_hold_anything(rng):
    own = drawn(rng)
    expected = own.evaluate(*everything(own))
    v, A = own.linearise(*everything(own))
    anything = constant(
        torch.where(own.present, v, torch.nan),
        torch.where(own.present[..., None], A, torch.inf),
        own.present,
        own.cutoff,
    )
    found = anything.evaluate(*everything(own))
    assert_close(found.cost, expected.cost, rtol=0, atol=0)
    assert_close(found.information, expected.information, rtol=0, atol=0)
    assert_close(found.gradient, expected.gradient, rtol=0, atol=0)
    assert_close(anything.weights(v.where(own.present, torch.nan)), own.weights(v), rtol=0, atol=0)
