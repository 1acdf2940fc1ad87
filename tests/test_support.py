import math

import pytest
import torch
from drawn_elements import (
    covariances,
    elements,
    moved,
    noisy,
    normal,
    poses,
    single,
    units,
    with_covariance,
)
from torch.testing import assert_close

from torchcal.match.elements import Elements, Kind
from torchcal.match.minimal_sets import Hypotheses
from torchcal.match.support import (
    are_best,
    are_new,
    count_distinct,
    explained,
    fingerprints,
    standard_errors,
)

WORD = "PPLLEE"


def drawn(word: str, members: int, rng: torch.Generator, sigma: float = 0.01) -> Elements:
    own = elements(word, normal(members, len(word), 3, rng=rng), units(members, len(word), rng=rng))
    return with_covariance(own, covariances(members, len(word), rng=rng, sigma=sigma))


def errors(poses_: Hypotheses, model: Elements, measured: Elements) -> torch.Tensor:
    return standard_errors(poses_, model, measured, measured.deviation())


def by_hand(own: Elements, i: int, other: Elements, j: int) -> float:
    """How many deviations the j-th measured is away from the i-th predicted element."""
    kind = int(own.kind[0, i])
    if kind != int(other.kind[0, j]):
        return torch.inf
    x, q, d, e = own.point[0, i], other.point[0, j], own.direction[0, i], other.direction[0, j]
    outer = e[:, None] * e
    across = torch.eye(3).to(e) - outer
    counted = outer if kind == Kind.PLANE else across  # a point's direction is 0
    bounds = [
        float(torch.linalg.matrix_norm(N @ other.covariance[0, j][part, part] @ N, ord=2))
        for N, part in ((counted, slice(0, 3)), (across, slice(3, 6)))
    ]
    offset = q - x
    if kind == Kind.POINT:
        return math.sqrt(float(offset @ offset) / bounds[0])
    if kind == Kind.LINE:
        off = offset - d * (d @ offset)
        chord = min(float((d - e).norm()), float((d + e).norm()))
    else:
        off = (d @ offset)[None]
        chord = float((d - e).norm())
    return math.sqrt(max(float(off @ off) / bounds[0], chord**2 / bounds[1]))


@pytest.mark.parametrize("word", ["PPP", WORD])
def test_standard_errors_are_those_of_plain_loops(word, rng):
    model, measured = drawn(word, 3, rng), drawn(word[:-1], 3, rng)
    poses_ = Hypotheses(batch=torch.tensor([0, 0, 2, 2, 2]), T=poses(5, rng=rng))
    found = errors(poses_, model, measured)
    assert found.shape == (5, len(word), len(word) - 1)
    for h, member in enumerate(poses_.batch.tolist()):
        rows = slice(member, member + 1)
        own, other = moved(poses_.T[h : h + 1], model[rows]), measured[rows]
        for i in range(len(word)):
            for j in range(len(word) - 1):
                expected = by_hand(own, i, other, j)
                # Squares of some metres are subtracted: 1e-15 of them, in standard deviations.
                assert float(found[h, i, j]) == pytest.approx(expected, rel=1e-7, abs=1e-4)


def test_they_are_small_at_the_true_pose_and_large_elsewhere(rng):
    T = poses(300, rng=rng)
    model = elements(WORD, normal(300, 6, 3, rng=rng), units(300, 6, rng=rng))
    exact = with_covariance(moved(T, model), covariances(300, 6, rng=rng))
    poses_ = Hypotheses(batch=torch.arange(300), T=T)
    error = errors(poses_, model, noisy(exact, rng=rng))
    own = error.diagonal(dim1=1, dim2=2)
    # 1800 elements of at most three components, in units that are not below a deviation.
    assert float(own.max()) < 5.0
    assert float(error[:, 0, 1].median()) > 30.0


def test_differences_are_taken_before_squares_far_from_the_origin(rng):
    model = Elements.points(torch.tensor([[[1000.0, 0, 0], [1000.0, 0.01, 0]]]))
    measured = Elements.points(model.point, torch.eye(3).expand(1, 2, 3, 3))
    poses_ = Hypotheses(batch=torch.zeros(1, dtype=torch.int64), T=torch.eye(4)[None])
    expected = torch.tensor([[[0.0, 0.01], [0.01, 0.0]]])
    assert_close(errors(poses_, model, measured), expected, rtol=1e-5, atol=0)


def test_what_is_not_finite_is_infinitely_far_and_leaves_the_others(rng):
    model, measured = drawn(WORD, 2, rng), drawn(WORD, 2, rng)
    poses_ = Hypotheses(batch=torch.tensor([0, 1, 1]), T=poses(3, rng=rng))
    expected = errors(poses_, model, measured)
    measured.point[1, 3] = torch.nan
    measured.direction[1, 4] = torch.nan
    measured.covariance[1, 0] = torch.nan
    poses_.T[0, 0, 0] = torch.nan
    found = errors(poses_, model, measured)
    expected[1:, :, [0, 3, 4]] = torch.inf
    expected[0] = torch.inf
    assert_close(found, expected, rtol=0, atol=0)


@pytest.mark.parametrize("word", ["PPP", WORD])
def test_explained_are_the_pairs_within_the_gate(word, rng):
    model, measured = (drawn(word, 3, rng, sigma=0.6) for _ in range(2))
    measured.point[1, 0] = torch.nan
    poses_ = Hypotheses(batch=torch.tensor([0, 0, 1, 2]), T=poses(4, rng=rng))
    found = explained(poses_, model, measured, measured.deviation(), gate=2.5)
    assert found.tolist() == (errors(poses_, model, measured) <= 2.5).tolist()
    assert 0.01 < float(found.double().mean()) < 0.9


def test_dtype_follows_the_elements_and_nothing_gives_nothing(rng):
    model, measured = single(drawn(WORD, 2, rng)), single(drawn(WORD, 2, rng))
    poses_ = Hypotheses(batch=torch.tensor([1]), T=poses(1, rng=rng).float())
    assert errors(poses_, model, measured).dtype == torch.float32
    none = poses_[torch.zeros(0, dtype=torch.int64)]
    assert errors(none, model, measured).shape == (0, 6, 6)


def test_distinct_counts_the_elements_of_the_side_that_has_fewer(rng):
    pairs = torch.rand(4, 50, 5, 7, generator=rng) < 0.15
    found = count_distinct(pairs)
    for row, count in zip(pairs.flatten(0, 1).tolist(), found.flatten().tolist(), strict=True):
        own = {i for i, line in enumerate(row) for pair in line if pair}
        others = {j for line in row for j, pair in enumerate(line) if pair}
        assert count == min(len(own), len(others))
    assert count_distinct(torch.zeros(3, 0, 7, dtype=torch.bool)).tolist() == [0, 0, 0]


def prints(batch: torch.Tensor, pairs: torch.Tensor) -> torch.Tensor:
    """Fingerprints of poses of points."""
    members = int(batch.max()) + 1 if len(batch) else 1
    own, others = (Elements.points(torch.zeros(members, n, 3)) for n in pairs.shape[1:])
    poses_ = Hypotheses(batch=batch, T=torch.eye(4).expand(len(batch), 4, 4))
    return fingerprints(poses_, own, others, pairs)


def test_the_same_pairs_with_a_line_turned_are_another_pose():
    z = torch.tensor([[[0.0, 0.0, 1.0]]])
    lines = Elements.lines(torch.zeros(1, 1, 3), z)
    turns = torch.stack([torch.eye(4), torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0]))])
    poses_ = Hypotheses(batch=torch.zeros(2, dtype=torch.int64), T=turns)
    found = fingerprints(poses_, lines, lines, torch.ones(2, 1, 1, dtype=torch.bool))
    assert found[0] != found[1]


def test_new_are_the_first_of_each_member_with_the_same_pairs(rng):
    pairs = torch.rand(300, 2, 3, generator=rng) < 0.4
    batch = torch.arange(300) // 75
    seen, expected = set(), []
    for member, row in zip(batch.tolist(), pairs.flatten(1).tolist(), strict=True):
        expected.append((member, *row) not in seen)
        seen.add((member, *row))
    assert are_new(batch, prints(batch, pairs)).tolist() == expected
    assert 0.1 < sum(expected) / 300 < 0.9


def test_new_does_not_need_the_order_of_the_members():
    pairs = torch.tensor([[[True]], [[True]], [[False]], [[True]]])
    batch = torch.tensor([1, 0, 1, 1])
    assert are_new(batch, prints(batch, pairs)).tolist() == [True, True, True, False]


def test_best_are_all_with_the_highest_score_of_their_member(rng):
    batch = torch.randint(5, (60,), generator=rng)
    batch[batch == 3] = 4
    score = torch.randint(-4, 4, (60,), generator=rng)
    rows = list(zip(batch.tolist(), score.tolist(), strict=True))
    expected = [s == max(t for c, t in rows if c == b) for b, s in rows]
    assert are_best(batch, score, 5).tolist() == expected
    assert sum(expected) > 4


def test_no_hypotheses_are_neither_new_nor_best():
    none = torch.zeros(0, dtype=torch.int64)
    assert are_new(none, prints(none, torch.zeros(0, 2, 3, dtype=torch.bool))).shape == (0,)
    assert are_best(none, none, 4).shape == (0,)
