import pytest
import torch
from drawn_elements import normal, poses, units
from torch.testing import assert_close

from torchcal.geometry.alignment import orthonormal_axes, rotation_from_directions, solve_3x3

EYE = torch.eye(3, dtype=torch.float64)


def assert_exact(found: torch.Tensor, expected: torch.Tensor) -> None:
    """To rounding: a few products of numbers of size 1."""
    assert_close(found, expected, rtol=0.0, atol=1e-12)


def test_rotation_of_two_directions_is_found_whatever_their_lengths(rng):
    R = poses(50, rng=rng)[:, :3, :3]
    a = normal(50, 2, 3, rng=rng)
    lengths = torch.rand(50, 2, 1, generator=rng, dtype=torch.float64) + 0.1
    found = rotation_from_directions(a, lengths * (a @ R.mT))
    # Two directions at an angle of 0.01 rad are the worst of 50: rounding grows by its inverse.
    assert_close(found, R, rtol=0.0, atol=1e-11)


def test_a_quarter_turn_by_hand():
    a = torch.stack([EYE[0], EYE[1]])
    b = torch.stack([EYE[1], -EYE[0]])
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    assert_exact(rotation_from_directions(a, b), quarter)


def test_directions_at_another_angle_give_a_rotation_that_shares_the_error(rng):
    a, b = units(100, 2, rng=rng), units(100, 2, rng=rng)
    R = rotation_from_directions(a, b)
    assert_exact(R @ R.mT, EYE.expand(100, 3, 3))
    assert_exact(torch.linalg.det(R), torch.ones(100, dtype=torch.float64))
    error = ((a @ R.mT) * b).sum(-1)
    assert_exact(error[:, 0], error[:, 1])


@pytest.mark.parametrize("second", [[2.0, 0, 0], [-1.0, 0, 0], [0.0, 0, 0]], ids=str)
def test_parallel_opposite_and_zero_directions_have_no_rotation(second):
    bad = torch.stack([EYE[0], torch.tensor(second, dtype=torch.float64)])
    good = EYE[:2]
    found = rotation_from_directions(torch.stack([bad, good]), torch.stack([good, good]))
    assert not found[0].isfinite().all()
    assert_exact(found[1], EYE)


def test_cramer_is_the_solution_of_lapack(rng):
    matrix, right = normal(4, 5, 3, 3, rng=rng), normal(4, 5, 3, rng=rng)
    expected = torch.linalg.solve(matrix, right)
    assert_close(solve_3x3(matrix, right, least=0.0), expected, rtol=1e-10, atol=1e-10)


def test_systems_below_the_least_determinant_are_nan_and_leave_the_others():
    matrix = EYE.repeat(4, 1, 1)
    matrix[1, 0, 0], matrix[2, 2, 2], matrix[3, 1, 1] = 0.0, 0.09, 0.11
    right = torch.ones(4, 3, dtype=torch.float64)
    found = solve_3x3(matrix, right, least=0.1)
    assert found[1:3].isnan().all()
    assert_close(found[0], right[0])
    assert_close(found[3, 1], torch.tensor(1 / 0.11, dtype=torch.float64))


def test_axes_are_right_handed_and_end_in_the_direction(rng):
    direction = torch.cat([units(50, rng=rng), EYE, -EYE])
    axes = orthonormal_axes(direction)
    assert_close(axes[:, 2], direction, rtol=0, atol=0)
    assert_exact(axes @ axes.mT, EYE.expand(56, 3, 3))
    assert_exact(torch.linalg.det(axes), torch.ones(56, dtype=torch.float64))


def test_dtype_follows_the_inputs_and_nothing_gives_nothing(rng):
    pair = units(2, rng=rng).float()
    assert rotation_from_directions(pair, pair).dtype == torch.float32
    assert solve_3x3(EYE.float(), pair[0], least=0.1).dtype == torch.float32
    assert orthonormal_axes(pair).dtype == torch.float32
    none = torch.zeros(0, 2, 3, dtype=torch.float64)
    assert rotation_from_directions(none, none).shape == (0, 3, 3)
    assert orthonormal_axes(none).shape == (0, 2, 3, 3)
