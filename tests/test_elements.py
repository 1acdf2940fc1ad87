import pytest
import torch
from drawn_elements import covariances, normal, units, well_placed
from torch.testing import assert_close

from torchcal.match.elements import Elements, Kind
from torchcal.match.pairs import Pairs


def test_points_carry_their_covariance_and_no_direction(rng):
    point, full = normal(2, 4, 3, rng=rng), covariances(2, 4, rng=rng)
    found = Elements.points(point, full[..., :3, :3])
    assert found.kind.eq(Kind.POINT).all()
    assert found.direction.eq(0).all()
    assert_close(found.covariance[..., :3, :3], full[..., :3, :3])
    assert found.covariance[..., 3:, :].eq(0).all()
    assert found.covariance[..., 3:].eq(0).all()


@pytest.mark.parametrize(("make", "kind"), [(Elements.lines, 1), (Elements.planes, 2)])
def test_directions_of_any_length_become_unit_vectors(make, kind, rng):
    point, direction = normal(2, 4, 3, rng=rng), units(2, 4, rng=rng)
    full = covariances(2, 4, rng=rng)
    found = make(point, 7.0 * direction, full)
    assert found.kind.eq(kind).all()
    assert_close(found.direction, direction)
    assert_close(found.covariance, full, rtol=0, atol=0)


def test_without_a_covariance_elements_are_exact(rng):
    point = normal(4, 3, rng=rng)
    for found in (
        Elements.points(point),
        Elements.lines(point, point),
        Elements.planes(point, point),
    ):
        assert found.covariance.eq(0).all()


def test_join_keeps_the_order_and_count_and_says_what_is_directed(rng):
    point = normal(2, 3, 3, rng=rng)
    points, planes = Elements.points(point), Elements.planes(point + 1, point)
    both = Elements.join(points, planes)
    assert_close(both.point, torch.cat([point, point + 1], 1))
    assert both.kind.tolist() == [[0, 0, 0, 2, 2, 2]] * 2
    assert both.count == 6
    assert both.directed
    assert not points.directed


def test_members_are_chosen_repeated_and_flattened(rng):
    own = well_placed("PLE", 4, rng=rng)
    assert_close(own[torch.tensor([2, 0])].point, own.point[[2, 0]])
    spread = own[:1].expand(2, 3, 1)
    assert spread.point.shape == (2, 3, 1, 3, 3)
    assert_close(spread.flattened().direction, own.direction[:1].repeat(6, 1, 1))
    alone = Elements.points(normal(5, 3, rng=rng)).expand(7)
    assert alone.kind.shape == (7, 5)
    assert alone.flattened().covariance.shape == (7, 5, 6, 6)
    assert Elements.points(normal(5, 3, rng=rng)).flattened().point.shape == (1, 5, 3)
    assert Elements.points(normal(2, 3, 0, 3, rng=rng)).flattened().kind.shape == (6, 0)


def test_deviation_is_that_of_the_axes_across(rng):
    covariance = torch.diag(torch.tensor([1.0, 4.0, 9.0, 0.04, 0.01, 0.09], dtype=torch.float64))
    point, x, z = normal(1, 3, rng=rng), torch.zeros(1, 3).double(), torch.zeros(1, 3).double()
    x[0, 0] = z[0, 2] = 1.0
    kinds = [
        (Elements.points(point, covariance[None, :3, :3]), 3.0, 0.0),
        (Elements.lines(point, z, covariance[None]), 2.0, 0.2),
        (Elements.planes(point, z, covariance[None]), 3.0, 0.2),
        (Elements.planes(point, x, covariance[None]), 1.0, 0.3),
    ]
    for elements, position, direction in kinds:
        assert float(elements.deviation().position) == pytest.approx(position)
        assert float(elements.deviation().direction) == pytest.approx(direction)


def test_deviation_is_the_largest_over_a_ring_of_axes(rng):
    covariance = covariances(20, rng=rng, sigma=1.0)
    d = torch.nn.functional.normalize(normal(20, 3, rng=rng), dim=-1)
    ring = normal(20, 4000, 3, rng=rng)
    across = torch.nn.functional.normalize(ring - (ring @ d[..., None]) * d[:, None], dim=-1)
    found = Elements.lines(d, d, covariance).deviation()
    for value, part in ((found.position, slice(0, 3)), (found.direction, slice(3, 6))):
        along = ((across @ covariance[:, part, part]) * across).sum(-1).sqrt().amax(1)
        assert_close(value, along, rtol=1e-4, atol=0)


def test_deviation_without_a_covariance_is_nan_for_that_element_alone():
    covariance = torch.eye(3, dtype=torch.float64).repeat(2, 1, 1)
    covariance[0, 1, 1] = torch.nan
    found = Elements.points(torch.zeros(2, 3).double(), covariance).deviation().position
    assert found[0].isnan()
    assert found[1] == 1.0


def listed(pairs: Pairs) -> list[list[tuple[int, int]]]:
    rows = zip(pairs.model.tolist(), pairs.measured.tolist(), pairs.valid.tolist(), strict=True)
    return [[(i, j) for i, j, valid in zip(*row, strict=True) if valid] for row in rows]


def test_pairs_are_the_ones_of_every_matrix(rng):
    C = torch.rand(5, 3, 4, generator=rng) < 0.5
    C[2] = False
    expected = [[(i, j) for i in range(3) for j in range(4) if bool(C[b, i, j])] for b in range(5)]
    pairs = Pairs.of(C)
    assert listed(pairs) == expected
    assert pairs.model.shape[1] == max(map(len, expected))


def test_sorted_pairs_follow_their_key_and_keep_the_padding_last(rng):
    C = torch.rand(5, 3, 4, generator=rng) < 0.5
    C[2] = False
    pairs = Pairs.of(C)
    key = torch.tensor([2, 0, 1])
    found = pairs.sorted_by(key[pairs.model])
    expected = [sorted(row, key=lambda pair: int(key[pair[0]])) for row in listed(pairs)]
    assert listed(found) == expected
    assert_close(found.valid, pairs.valid)


@pytest.mark.parametrize("shape", [(0, 3, 4), (2, 0, 4), (2, 3, 0)], ids=str)
def test_matrices_without_elements_have_no_pairs(shape):
    pairs = Pairs.of(torch.zeros(*shape, dtype=torch.bool))
    assert pairs.valid.shape == (shape[0], 0)
