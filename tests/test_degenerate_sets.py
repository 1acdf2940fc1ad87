import pytest
import torch
from drawn_elements import elements, hypotheses, moved, noisy, one_to_one, poses, with_covariance

X, Y, Z = torch.eye(3, dtype=torch.float64)
NONE = torch.zeros(3, dtype=torch.float64)
DEGENERATE = {
    "collinear points": ("PPP", [NONE, X, 3 * X], [NONE, NONE, NONE]),
    "points in one place": ("PPP", [X, X, Y], [NONE, NONE, NONE]),
    "parallel lines": ("LL", [NONE, Y], [X, -X]),
    "a point on the line": ("PL", [2 * X, NONE], [NONE, X]),
    "a line in the plane": ("LE", [NONE, Y], [X, Z]),
    "a line across the plane": ("LE", [NONE, Y], [Z, Z]),
    "points above one another": ("PPE", [NONE, Z, X], [NONE, NONE, Z]),
    "a point and parallel planes": ("PEE", [NONE, X, Y], [NONE, Z, Z]),
    "two parallel planes": ("EEE", [NONE, X, Y], [Z, Z, X]),
    "opposite planes": ("EEE", [NONE, X, Y], [Z, -Z, X]),
    "planes along one axis": ("EEE", [NONE, X, Y], [X, Y, X + Y]),
}


AT_ONE_POINT = {"a point on the line", "points in one place"}
"""Any small error gives a direction to these, however short it is."""


@pytest.mark.parametrize("name", DEGENERATE)
def test_degenerate_sets_give_no_hypothesis(name, rng):
    word, point, direction = DEGENERATE[name]
    own = elements(word, torch.stack(point)[None], torch.stack(direction)[None]).expand(50)
    own = own.flattened()
    exact = moved(poses(50, rng=rng), own)
    assert len(hypotheses(own, exact, one_to_one(50, len(word))).T) == 0
    tilted = noisy(with_covariance(exact, 1e-6 * torch.eye(6, dtype=torch.float64)), rng=rng)
    found = hypotheses(own, tilted, one_to_one(50, len(word)))
    assert found.T.isfinite().all()
    assert len(found.T) == 0


@pytest.mark.parametrize("name", sorted(set(DEGENERATE) - AT_ONE_POINT))
def test_sets_that_are_nearly_degenerate_give_no_hypothesis(name, rng):
    word, point, direction = DEGENERATE[name]
    own = elements(word, torch.stack(point)[None], torch.stack(direction)[None]).expand(50)
    variance = 1e-4 * torch.eye(6, dtype=torch.float64)
    model = noisy(with_covariance(own.flattened(), variance), rng=rng)
    assert (
        len(hypotheses(model, moved(poses(50, rng=rng), model), one_to_one(50, len(word))).T) == 0
    )
