import math

import pytest
import torch
from torch.testing import assert_close

from torchcal.match.detection import Detect, every_candidate, nearest_candidate

BOTH = pytest.mark.parametrize("detect", [every_candidate, nearest_candidate])


def drawn(rng: torch.Generator) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Standard errors, candidates and cut-offs of 20 hypotheses with 4 and 5 elements."""
    error = 6.0 * torch.rand(20, 4, 5, generator=rng, dtype=torch.float64)
    error[:, 2, ::2] = torch.inf
    cutoff = 3.0 * torch.rand(20, generator=rng, dtype=torch.float64)
    return error, torch.rand(20, 4, 5, generator=rng) < 0.6, cutoff


def found(detect: Detect, error: torch.Tensor, C: torch.Tensor, c: torch.Tensor) -> list:
    """The valid pairs of every hypothesis."""
    pairs = detect(error, C, c)
    columns = (pairs.model.tolist(), pairs.measured.tolist(), pairs.valid.tolist())
    return [
        [(i, j) for i, j, valid in zip(*row, strict=True) if valid]
        for row in zip(*columns, strict=True)
    ]


def within(error: torch.Tensor, C: torch.Tensor, c: torch.Tensor, h: int, i: int) -> list[int]:
    """Candidates of which a corner of the cube of half width c is as far away, or farther."""
    return [
        j
        for j in range(error.shape[2])
        if bool(C[h, i, j])
        and math.isfinite(error[h, i, j])
        and float(error[h, i, j]) <= math.hypot(c[h], c[h], c[h])
    ]


def test_every_candidate_is_that_of_plain_loops(rng):
    error, C, c = drawn(rng)
    expected = [[(i, j) for i in range(4) for j in within(error, C, c, h, i)] for h in range(20)]
    assert found(every_candidate, error, C, c) == expected
    assert any(expected)


def test_the_nearest_candidate_is_that_of_plain_loops(rng):
    error, C, c = drawn(rng)
    expected = [
        [
            (i, min(near, key=lambda j: error[h, i, j]))
            for i in range(4)
            if (near := within(error, C, c, h, i))
        ]
        for h in range(20)
    ]
    assert found(nearest_candidate, error, C, c) == expected
    assert any(expected)


@BOTH
def test_without_a_cutoff_elements_of_other_kinds_are_still_no_pair(detect, rng):
    error, C, c = drawn(rng)
    C[3] = False
    c[:] = torch.inf
    rows = found(detect, error, C, c)
    assert rows[3] == []
    for h, row in enumerate(rows):
        assert all(error[h, i, j] < torch.inf and C[h, i, j] for i, j in row)


@BOTH
def test_a_nan_hypothesis_has_no_pairs_and_leaves_the_others(detect, rng):
    error, C, c = drawn(rng)
    expected = found(detect, error, C, c)
    error[4] = torch.nan
    c[5] = torch.nan
    expected[4] = expected[5] = []
    assert found(detect, error, C, c) == expected


@BOTH
@pytest.mark.parametrize("shape", [(0, 4, 5), (3, 0, 5), (3, 4, 0)], ids=str)
def test_nothing_to_detect_gives_no_pairs(detect, shape):
    error = torch.zeros(*shape, dtype=torch.float64)
    pairs = detect(error, error > 0, torch.ones(shape[0], dtype=torch.float64))
    assert len(pairs.valid) == shape[0]
    assert not pairs.valid.any()


def test_every_element_of_the_model_keeps_its_place_in_the_nearest(rng):
    error, C, c = drawn(rng)
    pairs = nearest_candidate(error, C, c)
    assert_close(pairs.model, torch.arange(4).expand(20, 4))
