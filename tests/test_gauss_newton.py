import numpy as np
import pytest
import torch
from scipy.optimize import least_squares
from torch.testing import assert_close

from torchcal.geometry import robust, se3
from torchcal.solve.gauss_newton import (
    GaussNewtonConfig,
    NormalEquations,
    StopReason,
    covariance,
    minimise,
    shared,
)

EXACT = GaussNewtonConfig(iterations=100, tolerance=1e-9)


def add(state: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    return state + step


def equations(r: torch.Tensor, A: torch.Tensor) -> NormalEquations:
    """Of residuals r = y - f with derivative A of f, one standard deviation each."""
    return NormalEquations(
        cost=0.5 * r.square().sum(-1),
        information=A.mT @ A,
        gradient=(A.mT @ r[..., None])[..., 0],
    )


def valley(x: torch.Tensor) -> NormalEquations:
    """Rosenbrock's function; its minimum, 0, is at (1, 1)."""
    r = torch.stack([1 - x[:, 0], -10 * (x[:, 1] - x[:, 0].square())], -1)
    one, zero = torch.ones_like(x[:, 0]), torch.zeros_like(x[:, 0])
    A = torch.stack([torch.stack([one, zero], -1), torch.stack([-20 * x[:, 0], 10 * one], -1)], -2)
    return equations(r, A)


def starts(count: int = 6) -> torch.Tensor:
    return 2 * torch.randn(
        count, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )


def test_a_linear_problem_is_solved_in_one_step(rng):
    A = torch.randn(4, 9, 3, generator=rng, dtype=torch.float64)
    y = torch.randn(4, 9, generator=rng, dtype=torch.float64)
    solution = minimise(
        lambda x, i: equations(y[i] - (A[i] @ x[..., None])[..., 0], A[i]),
        add,
        torch.zeros(4, 3, dtype=torch.float64),
        GaussNewtonConfig(iterations=1, damping=0.0),
    )
    assert_close(solution.state, torch.linalg.lstsq(A, y[..., None]).solution[..., 0])


def test_a_curved_valley_is_followed_to_its_end():
    solution = minimise(shared(valley), add, starts(), EXACT)
    assert solution.stop.eq(StopReason.CONVERGED).all()
    assert_close(solution.state, torch.ones(6, 2, dtype=torch.float64))


def test_robust_fit_is_that_of_scipy(rng):
    t = torch.linspace(0, 1, 30, dtype=torch.float64)
    y = 2 * torch.exp(-3 * t) + 0.02 * torch.randn(30, generator=rng, dtype=torch.float64)

    def residual(x: np.ndarray) -> np.ndarray:
        return (y.numpy() - x[0] * np.exp(-x[1] * t.numpy())) / 0.02

    def evaluate(x: torch.Tensor) -> NormalEquations:
        curve = torch.exp(-x[:, 1:] * t)
        A = torch.stack([curve, -x[:, :1] * t * curve], -1) / 0.02
        return equations((y - x[:, :1] * curve) / 0.02, A)

    start = torch.tensor([[1.0, 1.0]], dtype=torch.float64)
    solution = minimise(shared(evaluate), add, start, EXACT)
    expected = least_squares(residual, start[0].numpy(), xtol=1e-12, ftol=1e-12, gtol=1e-12)
    assert_close(solution.state[0], torch.from_numpy(expected.x), rtol=1e-6, atol=0)


def test_points_are_aligned_as_in_closed_form(rng):
    model = torch.randn(20, 3, generator=rng, dtype=torch.float64)
    truth = se3.exp(torch.tensor([0.3, -0.2, 0.5, 0.4, -0.6, 0.3], dtype=torch.float64))
    noise = 0.01 * torch.randn(20, 3, generator=rng, dtype=torch.float64)
    measured = se3.transform(truth, model) + noise

    def evaluate(T: torch.Tensor) -> NormalEquations:
        r = measured - se3.transform(T, model)
        eye = torch.eye(3, dtype=torch.float64).expand(20, 3, 3)
        A = T[:, None, :3, :3] @ torch.cat([eye, -se3.hat(model)], -1)
        return equations(r.flatten(1), A.flatten(1, 2))

    def retract(T: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        return T @ se3.exp(step)

    solution = minimise(shared(evaluate), retract, torch.eye(4, dtype=torch.float64)[None], EXACT)
    a, b = model - model.mean(0), measured - measured.mean(0)
    U, _, V = torch.linalg.svd(b.mT @ a)
    R = U @ V
    assert_close(solution.state[0, :3, :3], R, rtol=0, atol=1e-8)
    assert_close(solution.state[0, :3, 3], measured.mean(0) - R @ model.mean(0), rtol=0, atol=1e-8)


def test_a_batch_is_its_elements_bit_for_bit():
    whole = minimise(shared(valley), add, starts(), GaussNewtonConfig(iterations=12))
    alone = [
        minimise(shared(valley), add, x[None], GaussNewtonConfig(iterations=12)) for x in starts()
    ]
    assert_close(torch.cat([s.state for s in alone]), whole.state, rtol=0, atol=0)
    assert_close(torch.cat([s.stop for s in alone]), whole.stop)
    assert_close(torch.cat([s.iterations for s in alone]), whole.iterations)


def test_bad_elements_leave_the_others_bit_for_bit_as_they_were():
    singular, invalid, hopeless = 1, 2, 3

    def evaluate(x: torch.Tensor, element: torch.Tensor) -> NormalEquations:
        good = valley(x)
        flat = torch.where(element == singular, 1.0, 0.0)[:, None, None].double()
        information = torch.where(flat > 0, flat, good.information)
        bad = torch.where(element == invalid, torch.nan, 0.0)[:, None, None].double()
        turn = torch.where(element == hopeless, -1.0, 1.0)[:, None].double()
        return NormalEquations(
            cost=good.cost, information=information + bad, gradient=turn * good.gradient
        )

    expected = minimise(shared(valley), add, starts(), EXACT)
    solution = minimise(evaluate, add, starts(), EXACT)
    kept = [0, 4, 5]
    assert_close(solution.state[kept], expected.state[kept], rtol=0, atol=0)
    assert_close(solution.stop[kept], expected.stop[kept])
    assert solution.stop[invalid] == StopReason.INVALID
    assert_close(solution.state[invalid], starts()[invalid], rtol=0, atol=0)
    assert solution.stop[hopeless] == StopReason.STUCK
    assert_close(solution.state[hopeless], starts()[hopeless], rtol=0, atol=0)
    assert solution.state.isfinite().all()


def test_elements_that_have_stopped_are_not_evaluated_again():
    evaluated = torch.zeros(6, dtype=torch.int64)

    def evaluate(x: torch.Tensor, element: torch.Tensor) -> NormalEquations:
        evaluated[element] += 1
        return valley(x)

    solution = minimise(evaluate, add, starts(), EXACT)
    assert_close(evaluated, solution.iterations + 1)
    assert len(solution.iterations.unique()) > 1


def test_iterations_that_were_used_up_are_said():
    solution = minimise(
        shared(valley), add, starts(), GaussNewtonConfig(iterations=1, tolerance=1e-9)
    )
    assert solution.stop.eq(StopReason.ITERATIONS).all()
    assert solution.iterations.eq(1).all()


def test_an_impossible_state_is_never_accepted():
    def evaluate(x: torch.Tensor) -> NormalEquations:
        found = equations(3.0 - x, torch.ones(len(x), 1, 1, dtype=torch.float64))
        cost = torch.where(x[:, 0] > 2.0, torch.inf, found.cost)
        return NormalEquations(cost=cost, information=found.information, gradient=found.gradient)

    solution = minimise(shared(evaluate), add, torch.tensor([[0.0], [2.5]]).double(), EXACT)
    assert float(solution.state[0, 0]) <= 2.0
    assert solution.stop[1] == StopReason.INVALID


@pytest.mark.parametrize("ripple", [0.0, 0.05])
def test_the_cost_never_rises_by_more_than_the_ripple(ripple):
    def evaluate(x: torch.Tensor) -> NormalEquations:
        v = torch.tensor([0.0, 0.2, 8.0, 8.1, 8.3], dtype=torch.float64) - x
        w = robust.biweight(v, 4.685)
        ripples = 0.05 * torch.sin(40 * x[:, 0]).square()
        return NormalEquations(
            cost=robust.biweight_cost(v, 4.685).sum(1) + ripples,
            information=w.sum(1)[:, None, None],
            gradient=(w * v).sum(1, keepdim=True),
        )

    x = torch.linspace(-3, 11, 15, dtype=torch.float64)[:, None]
    costs = [evaluate(x).cost]
    for n in range(1, 10):
        config = GaussNewtonConfig(iterations=n, ripple=ripple)
        costs.append(minimise(shared(evaluate), add, x, config).equations.cost)
    path = torch.stack(costs)
    assert (path[1:] <= (1 + ripple) * path[:-1]).all()
    assert (path[-1] < path[0]).any()


def test_two_measurements_of_one_number_halve_the_variance():
    information = torch.tensor([[2.0]], dtype=torch.float64)
    assert_close(covariance(information), torch.tensor([[0.5]], dtype=torch.float64))


def test_covariance_is_the_inverse_over_very_unlike_units(rng):
    A = torch.randn(2, 3, 9, 4, generator=rng, dtype=torch.float64)
    A = A * torch.tensor([1.0, 1e6, 1e-5, 1e3], dtype=torch.float64)
    product = covariance(A.mT @ A) @ (A.mT @ A)
    scale = torch.tensor([1.0, 1e6, 1e-5, 1e3], dtype=torch.float64)
    expected = torch.eye(4, dtype=torch.float64).expand(2, 3, 4, 4)
    assert_close(product * scale[:, None] / scale, expected, rtol=0, atol=1e-9)


def test_only_singular_elements_have_no_covariance(rng):
    A = torch.randn(5, 9, 3, generator=rng, dtype=torch.float64)
    A[1, :, 2] = A[1, :, 0] + A[1, :, 1]
    information = A.mT @ A
    information[2], information[3] = 0.0, torch.nan
    found = covariance(information)
    assert found[1:4].isnan().all()
    for i in (0, 4):
        assert_close(found[i], covariance(information[i]), rtol=0, atol=0)
        assert_close(found[i], torch.linalg.inv(information[i]))


def test_steps_are_lengthened_where_the_gradient_falls_too_slowly():
    def overstated(x: torch.Tensor) -> NormalEquations:
        """A parabola whose information is ten times its curvature."""
        return NormalEquations(
            cost=0.05 * x[:, 0].square(),
            information=torch.ones(len(x), 1, 1).to(x),
            gradient=-0.1 * x,
        )

    start = torch.tensor([[1000.0], [-400.0]], dtype=torch.float64)
    plain = minimise(shared(overstated), add, start, GaussNewtonConfig(iterations=6))
    longer = minimise(shared(overstated), add, start, GaussNewtonConfig(iterations=6, longest=20.0))
    assert_close(plain.state / start, torch.full((2, 1), 0.9**6).to(start), rtol=1e-3, atol=0)
    assert ((longer.state / start).abs() < 1e-2).all()


def test_a_short_last_step_is_taken_and_its_end_not_evaluated(rng):
    A = torch.randn(2, 9, 3, generator=rng, dtype=torch.float64)
    y = 10.0 * torch.randn(2, 9, generator=rng, dtype=torch.float64)
    looks = []

    def evaluate(x: torch.Tensor, i: torch.Tensor) -> NormalEquations:
        looks.append(i.tolist())
        return equations(y[i] - (A[i] @ x[..., None])[..., 0], A[i])

    near = torch.linalg.lstsq(A, y[..., None]).solution[..., 0]
    start = torch.stack([near[0] + 1e-3, near[1] + 1e3])
    solution = minimise(evaluate, add, start, GaussNewtonConfig(damping=1e-12, trusted=1.0))
    assert looks == [[0, 1], [1]]
    assert solution.stop.eq(StopReason.CONVERGED).all()
    assert_close(solution.state, near)


def test_a_known_curvature_makes_robust_steps_converge_at_once(rng):
    y = torch.randn(20_000, generator=rng, dtype=torch.float64)
    c = torch.tensor(robust.EFFICIENT, dtype=torch.float64)

    def evaluate(x: torch.Tensor) -> NormalEquations:
        v = y - x
        w = robust.biweight(v, c)
        return NormalEquations(
            cost=robust.biweight_cost(v, c).sum(-1),
            information=w.sum(-1)[:, None, None],
            gradient=(w * v).sum(-1)[:, None],
        )

    def left(**settings: float) -> float:
        """Share of a start of 0.1 off the minimum that one step leaves."""
        config = GaussNewtonConfig(iterations=1, damping=1e-9, **settings)
        return float(minimise(shared(evaluate), add, best + 0.1, config).state - best) / 0.1

    best = minimise(shared(evaluate), add, torch.zeros(1, 1).to(y), EXACT).state
    curvature = float(robust.relative_curvature(c))
    assert abs(left() - (1.0 - curvature)) < 0.02
    assert abs(left(curvature=curvature)) < 0.02
