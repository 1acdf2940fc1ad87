import pytest
import torch
from drawn_elements import (
    covariances,
    elements,
    moved,
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

from torchcal.geometry import se3
from torchcal.match.elements import Elements
from torchcal.match.residuals import PairResiduals
from torchcal.solve.jacobian import Linearise, Residual, Retract, numerical

# torch itself uses what it deprecates when forward-mode differentiation is loaded.
pytestmark = pytest.mark.filterwarnings("ignore:.*torch.jit.script.*:DeprecationWarning")

WORDS = ["PPPP", "LLLL", "EEEE", "PPLLEE"]


def forward_mode(residual: Residual, retract: Retract, parameters: int) -> Linearise:
    """The derivative by forward-mode differentiation, a pass for each parameter."""

    def linearise(state: Tensor, problem: Tensor) -> tuple[Tensor, Tensor]:
        def moved(step: Tensor) -> Tensor:
            return residual(retract(state, step), problem)

        zero = state.new_zeros(len(state), parameters)
        columns = [
            torch.func.jvp(moved, (zero,), (direction.expand_as(zero),))[1]
            for direction in torch.eye(parameters, dtype=state.dtype, device=state.device)
        ]
        return residual(state, problem), -torch.stack(columns, -1)

    return linearise


def drawn(word: str, members: int, rng: torch.Generator) -> Elements:
    count = len(word)
    return elements(word, normal(members, count, 3, rng=rng), units(members, count, rng=rng))


def problems(word: str, members: int, rng: torch.Generator) -> PairResiduals:
    """Pairs of equal kinds at random, as many as there happen to be."""
    model, other = drawn(word, members, rng), drawn(word, members, rng)
    measured = with_covariance(other, covariances(members, len(word), rng=rng, sigma=0.3))
    C = torch.rand(members, len(word), len(word), generator=rng) < 0.4
    return residuals_of(model, measured, C & (model.kind[:, :, None] == measured.kind[:, None]))


def derivatives(own: PairResiduals, T: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Analytic, forward-mode and numerical, of the components that there are."""
    problem = torch.arange(len(T))
    ways = (
        own.linearise,
        forward_mode(own.residual, retract, 6),
        numerical(own.residual, retract, 6),
    )
    found = [way(T, problem) for way in ways]
    for v, _ in found:
        assert_close(v[own.present], found[0][0][own.present], rtol=0, atol=0)
    analytic, forward, differences = (A[own.present] for _, A in found)
    return analytic, forward, differences


@pytest.mark.parametrize("word", WORDS)
def test_analytic_forward_and_numerical_derivatives_agree(word, rng):
    own = problems(word, 30, rng)
    assert not own.present.any(-1).all()
    analytic, forward, differences = derivatives(own, poses(30, rng=rng))
    assert_close(analytic, forward, rtol=1e-9, atol=1e-9)
    # Central differences lose a third of the digits; lines across one another are steep.
    error = (differences - analytic).abs() / (1.0 + analytic.abs())
    assert float(error.median()) < 1e-8
    assert float(error.quantile(0.99)) < 1e-4


@pytest.mark.parametrize("word", WORDS)
@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-3])
def test_they_agree_where_nothing_is_turned(word, size, rng):
    model, T = drawn(word, 20, rng), poses(20, rng=rng)
    measured = with_covariance(moved(T, model), covariances(20, len(word), rng=rng, sigma=0.3))
    own = residuals_of(model, measured, one_to_one(20, len(word)))
    analytic, forward, differences = derivatives(own, T @ poses(20, rng=rng, size=size))
    assert_close(analytic, forward, rtol=1e-9, atol=1e-9)
    assert_close(analytic, differences, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("word", ["L", "E"])
@pytest.mark.parametrize("tilt", [1e-4, -1e-4, 1e-2, 1e2, -1e2])
def test_they_agree_next_to_perpendicular_and_opposite_directions(word, tilt, rng):
    """The predicted direction is (1, 0, tilt) before it is made a unit vector: +-z is the other."""
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand(20, 1, 3)
    tilted = torch.tensor([1.0, 0.0, tilt], dtype=torch.float64).expand(20, 1, 3)
    model = elements(word, normal(20, 1, 3, rng=rng), tilted)
    measured = elements(word, normal(20, 1, 3, rng=rng), up)
    measured = with_covariance(measured, covariances(20, 1, rng=rng, sigma=0.3))
    own = residuals_of(model, measured, one_to_one(20, 1))
    T = torch.eye(4, dtype=torch.float64).expand(20, 4, 4)
    analytic, forward, _ = derivatives(own, T)
    assert analytic.isfinite().all()
    scale = analytic.abs().amax()
    assert_close(analytic / scale, forward / scale, rtol=1e-8, atol=1e-12)


def test_v_falls_by_the_derivative_times_the_step(rng):
    own = problems("PPLLEE", 10, rng)
    T, step = poses(10, rng=rng), 1e-7 * normal(10, 6, rng=rng)
    problem = torch.arange(10)
    v, A = own.linearise(T, problem)
    after = own.residual(retract(T, step), problem)
    fall = (A @ step[:, None, :, None])[..., 0]
    error = (v - after - fall)[own.present]
    assert float(error.abs().median()) < 1e-3 * float(fall[own.present].abs().median())


def residual(state: Tensor, problem: Tensor) -> Tensor:
    """A cubic of two parameters, another one for each problem."""
    x, y = state.unbind(-1)
    return torch.stack([x**3 * (1 + problem), x * y], -1)[:, None]


def by_hand(state: Tensor, problem: Tensor) -> Tensor:
    x, y = state.unbind(-1)
    first = torch.stack([-3 * x**2 * (1 + problem), torch.zeros_like(x)], -1)
    return torch.stack([first, torch.stack([-y, -x], -1)], -2)[:, None]


def add(state: Tensor, step: Tensor) -> Tensor:
    return state + step


@pytest.mark.parametrize("way", [forward_mode, numerical])
def test_the_derivative_of_a_cubic_by_hand(way, rng):
    state, problem = normal(5, 2, rng=rng), torch.tensor([4, 0, 2, 1, 3])
    v, A = way(residual, add, 2)(state, problem)
    assert_close(v, residual(state, problem), rtol=0, atol=0)
    # Central differences of 6e-6 leave 4e-11 of a cubic's third derivative, and rounding as much.
    assert_close(A, by_hand(state, problem), rtol=1e-8, atol=1e-8)


def test_the_step_of_the_differences_can_be_chosen():
    state, problem = torch.ones(1, 2, dtype=torch.float64), torch.zeros(1, dtype=torch.int64)
    _, A = numerical(residual, add, 2, step=0.5)(state, problem)
    assert float(A[0, 0, 0, 0]) == pytest.approx(-(1.5**3 - 0.5**3))


@pytest.mark.parametrize("way", [forward_mode, numerical])
def test_dtype_follows_and_nothing_gives_nothing(way, rng):
    own = problems("PPLLEE", 3, rng)
    linearise = way(own.residual, retract, 6)
    none = linearise(torch.zeros(0, 4, 4, dtype=torch.float64), torch.zeros(0, dtype=torch.int64))
    assert none[1].shape == (0, *own.present.shape[1:], 6)
    model = single(drawn("PLE", 2, rng))
    measured = single(with_covariance(drawn("PLE", 2, rng), covariances(2, 3, rng=rng)))
    small = residuals_of(model, measured, one_to_one(2, 3))
    v, A = way(small.residual, retract, 6)(se3.exp(torch.zeros(2, 6)), torch.arange(2))
    assert (v.dtype, A.dtype) == (torch.float32, torch.float32)


@pytest.mark.parametrize("way", [forward_mode, numerical])
def test_a_problem_that_is_not_finite_leaves_the_others(way, rng):
    own = problems("PPLLEE", 5, rng)
    T, problem = poses(5, rng=rng), torch.arange(5)
    expected = way(own.residual, retract, 6)(T, problem)[1]
    own.q[2] = torch.nan
    found = way(own.residual, retract, 6)(T, problem)[1]
    kept = torch.tensor([0, 1, 3, 4])
    assert_close(found[kept], expected[kept], rtol=0, atol=0)
    assert found[2][own.present[2]].isnan().any()
