import itertools

import pytest
import torch
from drawn_elements import (
    covariances,
    hypotheses,
    moved,
    noisy,
    one_to_one,
    poses,
    single,
    well_placed,
    with_covariance,
)
from torch.testing import assert_close

from torchcal.geometry import se3
from torchcal.match.elements import Elements
from torchcal.match.minimal_sets import Hypotheses

SETS = {"PPP": 1, "PPE": 1, "PEE": 1, "EEE": 1, "LL": 2, "PL": 2, "LE": 1}
"""How many poses each combination has: lines fix a turn by half about their normal only."""


def nearest(found: Hypotheses, T: torch.Tensor) -> torch.Tensor:
    """How far the best hypothesis of each member is from its pose, in any entry."""
    error = (found.T - T[found.batch]).abs().flatten(1).amax(1)
    return error.new_full((len(T),), torch.inf).scatter_reduce(0, found.batch, error, "amin")


@pytest.mark.parametrize("word", SETS)
def test_exact_elements_give_the_exact_pose(word, rng):
    model, T = well_placed(word, 100, rng=rng), poses(100, rng=rng)
    found = hypotheses(model, moved(T, model), one_to_one(100, len(word)))
    assert float(nearest(found, T).max()) < 1e-9  # rounding, ten times worse for oblique sets
    assert_close(found.batch.bincount(), torch.full((100,), SETS[word]))
    assert_close(found.T[:, 3], torch.eye(4, dtype=torch.float64)[3].expand_as(found.T[:, 3]))


@pytest.mark.parametrize("word", SETS)
def test_every_hypothesis_carries_the_model_onto_what_was_measured(word, rng):
    model, T = well_placed(word, 50, rng=rng), poses(50, rng=rng)
    measured = moved(T, model)
    found = hypotheses(model, measured, one_to_one(50, len(word)))
    carried, expected = moved(found.T, model[found.batch]), measured[found.batch]
    offset = carried.point - expected.point
    d, e = carried.direction, expected.direction
    on_line = offset - e * (e * offset).sum(-1, keepdim=True)
    on_plane = e * (e * offset).sum(-1, keepdim=True)
    kind = expected.kind[..., None]
    missed = torch.where(kind == 1, on_line, torch.where(kind == 2, on_plane, offset))
    assert_close(missed, torch.zeros_like(missed), rtol=0, atol=1e-9)
    sense = torch.where(kind == 1, (d * e).sum(-1, keepdim=True).sign(), 1.0)
    assert_close(sense * d, e, rtol=0, atol=1e-9)


@pytest.mark.parametrize("word", SETS)
def test_noise_of_one_sigma_loses_no_set_and_keeps_it_near_the_truth(word, rng):
    model, T = well_placed(word, 300, rng=rng), poses(300, rng=rng)
    exact = with_covariance(moved(T, model), covariances(300, len(word), rng=rng, sigma=0.01))
    found = hypotheses(model, noisy(exact, rng=rng), one_to_one(300, len(word)))
    # Levers of some metres, at angles where noise counts three times: the median of the worst
    # kind of sets is 0.021, and the largest of 2100 is 0.078.
    assert float(nearest(found, T).max()) < 0.15
    assert float(nearest(found, T).median()) < 0.03


def cube() -> torch.Tensor:
    return torch.cartesian_prod(*[torch.tensor([0.0, 1.0], dtype=torch.float64)] * 3)


def angles(rows: torch.Tensor) -> torch.Tensor:
    """Cosines between the two directions that leave the first of three points."""
    one, two = rows[1] - rows[0], rows[2] - rows[0]
    return (one @ two) / one.norm() / two.norm()


def point_sets(p: torch.Tensor, q: torch.Tensor, C: torch.Tensor) -> int:
    """Three candidates without a common element, with equal sides and not in a line."""
    count = 0
    for three in itertools.combinations(C.nonzero().tolist(), 3):
        i, j = (list(side) for side in zip(*three, strict=True))
        if len(set(i)) == len(set(j)) == 3:
            sides = (torch.pdist(p[i]) - torch.pdist(q[j])).abs().max()
            count += bool(sides < 1e-6) and abs(float(angles(p[i]))) < 0.99
    return count


def test_all_minimal_sets_of_a_cube_are_found(rng):
    model = Elements.points(cube().expand(4, 8, 3))
    measured = moved(poses(4, rng=rng), model)
    C = torch.rand(4, 8, 8, generator=rng) < 0.25
    found = hypotheses(model, measured, C)
    expected = [point_sets(model.point[b], measured.point[b], C[b]) for b in range(4)]
    assert found.batch.bincount(minlength=4).tolist() == expected
    assert min(expected) > 10


def plane_sets(n: torch.Tensor, m: torch.Tensor, C: torch.Tensor) -> int:
    """Three candidates without a common element, with equal angles and one common point."""
    count = 0
    for three in itertools.combinations(C.nonzero().tolist(), 3):
        i, j = (list(side) for side in zip(*three, strict=True))
        if len(set(i)) == len(set(j)) == 3:
            equal = (n[i] @ n[i].mT - m[j] @ m[j].mT).abs().max() < 1e-6
            count += bool(equal) and abs(float(torch.linalg.det(n[i]))) > 0.5
    return count


def test_all_minimal_sets_of_the_faces_of_a_box_are_found(rng):
    normals = torch.cat([torch.eye(3), -torch.eye(3)]).double()
    model = Elements.planes(torch.rand(6, 1).double() * normals, normals).expand(3)
    measured = moved(poses(3, rng=rng), model)
    C = torch.rand(3, 6, 6, generator=rng) < 0.4
    found = hypotheses(model, measured, C)
    expected = [plane_sets(normals, measured.direction[b], C[b]) for b in range(3)]
    assert found.batch.bincount(minlength=3).tolist() == expected
    assert min(expected) > 5


def kinds_of_sets(word: str) -> int:
    """Poses of all sets of a word whose elements agree one to one."""
    twos = [SETS.get("".join(two), 0) for two in itertools.combinations(word, 2)]
    threes = [SETS.get("".join(three), 0) for three in itertools.combinations(word, 3)]
    return sum(twos) + sum(threes)


@pytest.mark.parametrize("word", ["PLL", "LLE", "PPL", "PLE", "LEE", "PPE", "LLL"])
def test_mixtures_give_every_set_of_two_and_of_three_once(word, rng):
    model = well_placed(word, 20, rng=rng)
    found = hypotheses(model, moved(poses(20, rng=rng), model), one_to_one(20, 3))
    assert found.batch.bincount().tolist() == [kinds_of_sets(word)] * 20


def test_the_order_of_the_elements_does_not_matter(rng):
    model, T = well_placed("EPP", 20, rng=rng), poses(20, rng=rng)
    found = hypotheses(model, moved(T, model), one_to_one(20, 3))
    assert float(nearest(found, T).max()) < 1e-9


def test_elements_of_other_kinds_are_never_paired(rng):
    model, T = well_placed("LLE", 10, rng=rng), poses(10, rng=rng)
    measured = moved(T, model)
    everything = hypotheses(model, measured, torch.ones(10, 3, 3, dtype=torch.bool))
    same = model.kind[:, :, None] == measured.kind[:, None]
    only = hypotheses(model, measured, same)
    assert_close(everything.T, only.T, rtol=0, atol=0)
    assert float(nearest(everything, T).max()) < 1e-9


def test_a_member_is_the_same_in_any_company(rng):
    words = ("PPL", "LEE", "LLE")
    parts = [well_placed(word, 1, rng=rng) for word in words]
    model = Elements(
        kind=torch.cat([part.kind for part in parts]),
        point=torch.cat([part.point for part in parts]),
        direction=torch.cat([part.direction for part in parts]),
        covariance=torch.cat([part.covariance for part in parts]),
    )
    measured = moved(poses(3, rng=rng), model)
    C = torch.ones(3, 3, 3, dtype=torch.bool)
    together = hypotheses(model, measured, C)
    for member in range(3):
        rows = slice(member, member + 1)
        alone = hypotheses(model[rows], measured[rows], C[rows])
        assert_close(together.T[together.batch == member], alone.T, rtol=0, atol=1e-14)


def test_a_member_that_is_not_finite_has_no_hypotheses_and_leaves_the_others(rng):
    model = well_placed("PPP", 3, rng=rng)
    measured = moved(poses(3, rng=rng), model)
    expected = hypotheses(model, measured, one_to_one(3, 3))
    measured.point[1, 2] = torch.nan
    found = hypotheses(model, measured, one_to_one(3, 3))
    assert found.batch.tolist() == [0, 2]
    assert_close(found.T, expected.T[[0, 2]], rtol=0, atol=0)


def test_a_sample_holds_at_most_the_limit_of_each_member(rng):
    model = Elements.points(cube().expand(3, 8, 3))
    measured = moved(poses(3, rng=rng), model)
    C = torch.ones(3, 8, 8, dtype=torch.bool)
    C[1] = one_to_one(1, 8)[0]
    C[2] = False
    every = hypotheses(model, measured, C, limit=100_000)
    some = hypotheses(model, measured, C, limit=60)
    counts = every.batch.bincount(minlength=3)
    assert int(counts[0]) > 60 > int(counts[1]) > 0
    assert_close(some.batch.bincount(minlength=3), counts.clamp(max=60))
    # Products of matrices of another number of sets round in another way.
    assert_close(some.T[some.batch == 1], every.T[every.batch == 1], rtol=0, atol=1e-12)
    difference = (some.T[:60, None] - every.T[None, : int(counts[0])]).abs().flatten(2).amax(2)
    assert (difference < 1e-12).any(1).all()


def test_a_sample_follows_its_generator_and_is_even(rng):
    model = Elements.points(cube()[None])
    C = one_to_one(1, 8)
    measured = noisy(with_covariance(model, 1e-8 * torch.eye(6, dtype=torch.float64)), rng=rng)
    every = hypotheses(model, measured, C).T
    draws = [hypotheses(model, measured, C, limit=14, seed=seed).T for seed in range(200)]
    again = hypotheses(model, measured, C, limit=14, seed=199).T
    assert_close(again, draws[199], rtol=0, atol=0)
    seen = torch.zeros(len(every))
    for found in draws:
        seen += ((every[:, None] - found).abs() < 1e-12).flatten(2).all(2).any(1)
    # 200 draws of 14 out of 56: 50 each, with a deviation of 6.1; five of them.
    assert len(every) == 56
    assert int(seen.min()) >= 20
    assert int(seen.max()) <= 80


@pytest.mark.parametrize("shape", [(0, 3, 3), (2, 0, 3), (2, 3, 0), (2, 3, 3)], ids=str)
@pytest.mark.parametrize("word", ["PPP", "LLE"])
def test_nothing_to_match_gives_no_hypotheses(word, shape, rng):
    members, own, others = shape
    model, measured = (
        well_placed(word[:count], max(members, 1), rng=rng)[:members] for count in (own, others)
    )
    found = hypotheses(model, measured, torch.zeros(*shape, dtype=torch.bool))
    assert found.T.shape == (0, 4, 4)
    assert found.batch.shape == (0,)


@pytest.mark.parametrize("word", SETS)
def test_dtype_follows_the_elements(word, rng):
    model, T = single(well_placed(word, 20, rng=rng)), poses(20, rng=rng)
    noise = 1e-10 * torch.eye(6, dtype=torch.float64)
    measured = single(with_covariance(moved(T, well_placed(word, 20, rng=rng)), noise))
    exact = Elements(
        kind=measured.kind,
        point=se3.transform(T.float(), model.point),
        direction=model.direction @ T[:, :3, :3].float().mT,
        covariance=measured.covariance,
    )
    found = hypotheses(model, exact, one_to_one(20, len(word)))
    assert found.T.dtype == torch.float32
    # float32 has 7 digits, and oblique sets lose one or two.
    assert float(nearest(found, T.float()).max()) < 1e-4


def test_the_default_dtype_of_torch_does_not_matter(rng):
    model = single(well_placed("LL", 2, rng=rng))
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    try:
        assert hypotheses(model, model, one_to_one(2, 2)).T.dtype == torch.float32
    finally:
        torch.set_default_dtype(before)


def test_joined_hypotheses_are_in_the_order_of_the_members(rng):
    T = poses(5, rng=rng)
    one = Hypotheses(batch=torch.tensor([0, 2, 2]), T=T[:3])
    two = Hypotheses(batch=torch.tensor([0, 1]), T=T[3:])
    found = Hypotheses.join(one, two)
    assert found.batch.tolist() == [0, 0, 1, 2, 2]
    assert_close(found.T, T[[0, 3, 4, 1, 2]], rtol=0, atol=0)
    assert found[torch.tensor([2])].batch.tolist() == [1]
