import itertools

import numpy as np
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
from scipy.optimize import minimize_scalar
from torch.testing import assert_close

from torchcal.match.elements import Elements, Kind
from torchcal.match.invariants import GAMMA, Invariants

WORD = "PPLLLEE"


def drawn(members: int, rng: torch.Generator) -> Elements:
    count = len(WORD)
    return elements(WORD, normal(members, count, 3, rng=rng), units(members, count, rng=rng))


def closest(p: np.ndarray, d: np.ndarray, q: np.ndarray, e: np.ndarray) -> float:
    """How near two lines come: the points of one, and for each the foot on the other."""
    a = np.stack([d, -e], 1)
    along = np.linalg.lstsq(a, q - p, rcond=None)[0]
    return float(np.linalg.norm(p + along[0] * d - q - along[1] * e))


def distance(one: tuple, two: tuple) -> float:
    """By hand, for kinds in ascending order."""
    (a, p, d), (b, q, e) = one, two
    match a, b:
        case Kind.POINT, Kind.POINT:
            return float(np.linalg.norm(p - q))
        case Kind.POINT, Kind.LINE:
            nearest = minimize_scalar(lambda s: np.sum((q + s * e - p) ** 2), tol=1e-14)
            return float(np.sqrt(nearest.fun))
        case Kind.POINT, Kind.PLANE:
            return float(e @ p - e @ q)
        case Kind.LINE, Kind.LINE:
            return closest(p, d, q, e)
    return 0.0


def angle(one: tuple, two: tuple) -> float:
    (a, _, d), (b, _, e) = one, two
    if Kind.POINT in (a, b):
        return 0.0
    between = float(np.arccos(np.clip(d @ e, -1, 1)))
    return min(between, np.pi - between) if Kind.LINE in (a, b) else between


def test_distances_and_angles_are_those_of_plain_geometry(rng):
    own = drawn(1, rng)
    rows = list(
        zip(own.kind[0].tolist(), own.point[0].numpy(), own.direction[0].numpy(), strict=True)
    )
    found = Invariants.of(own)
    for (i, one), (j, two) in itertools.combinations(enumerate(rows), 2):
        for a, b in ((i, j), (j, i)):
            # The search for the foot stops at the root of the precision; its value is exact.
            assert float(found.distance[0, a, b]) == pytest.approx(distance(one, two), abs=1e-9)
            # arccos of the oracle loses half the digits near 1.
            assert float(found.angle[0, a, b]) == pytest.approx(angle(one, two), abs=1e-7)


def test_parallel_lines_have_their_distance():
    point = torch.tensor([[0.0, 0, 0], [5.0, 3.0, 4.0]], dtype=torch.float64)
    along = torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]], dtype=torch.float64)
    found = Invariants.of(Elements.lines(point, along))
    assert float(found.distance[0, 1]) == pytest.approx(5.0)
    assert float(found.angle[0, 1]) == 0.0


def test_no_motion_changes_them(rng):
    own = with_covariance(drawn(20, rng), 1e-4 * torch.eye(6, dtype=torch.float64))
    before, after = Invariants.of(own), Invariants.of(moved(poses(20, rng=rng, size=2.0), own))
    for name in ("angle", "distance", "angle_variance", "distance_variance"):
        # Points are some metres away: 1e-15 of squares, so a distance near 0 has 1e-7.
        assert_close(getattr(after, name), getattr(before, name), rtol=1e-9, atol=2e-7)


def test_they_do_not_depend_on_which_point_or_sense_a_line_names(rng):
    own = drawn(20, rng)
    is_line = (own.kind == Kind.LINE)[..., None]
    shift = normal(20, len(WORD), 1, rng=rng)
    other = Elements(
        kind=own.kind,
        point=torch.where(is_line, own.point + shift * own.direction, own.point),
        direction=torch.where(is_line, -own.direction, own.direction),
        covariance=own.covariance,
    )
    assert_close(Invariants.of(other).angle, Invariants.of(own).angle)
    before, after = Invariants.of(own).distance, Invariants.of(other).distance
    skewed = (sines(own) > 0.1) | ~(is_line & is_line.mT)
    assert_close(after[skewed], before[skewed], rtol=0, atol=1e-7)


def sines(own: Elements) -> torch.Tensor:
    """Of the angles between every two directions."""
    d = own.direction
    return torch.linalg.cross(*torch.broadcast_tensors(d[:, :, None], d[:, None])).norm(dim=-1)


def agreement(own: Invariants, other: Invariants, members: int, count: int) -> torch.Tensor:
    """Of every two elements with the same two."""
    batch, i, j = torch.ones(members, count, count).nonzero(as_tuple=True)
    return own.agree(other, batch, (i, j), (i, j)).view(members, count, count)


def test_moved_elements_agree_with_themselves_without_any_noise(rng):
    own = drawn(50, rng)
    other = moved(poses(50, rng=rng), own)
    assert agreement(Invariants.of(own), Invariants.of(other), 50, len(WORD)).all()


def test_agreement_is_a_difference_of_less_than_gamma_deviations():
    sigma = 0.01
    covariance = (sigma**2 * torch.eye(3, dtype=torch.float64)).expand(2, 3, 3)
    far = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64)
    model = Invariants.of(Elements.points(torch.stack([0 * far, far])).expand(1))
    for factor, expected in ((0.99, True), (1.01, False)):
        other = (1.0 + factor * GAMMA * sigma * 2**0.5) * far
        measured = Invariants.of(
            Elements.points(torch.stack([0 * far, other]), covariance).expand(1)
        )
        assert bool(agreement(model, measured, 1, 2)[0, 0, 1]) is expected


def test_noise_of_one_sigma_loses_nothing(rng):
    own = drawn(400, rng)
    exact = with_covariance(moved(poses(400, rng=rng), own), covariances(400, len(WORD), rng=rng))
    found = agreement(Invariants.of(own), Invariants.of(noisy(exact, rng=rng)), 400, len(WORD))
    lines = (own.kind == Kind.LINE)[..., None]
    # Next to PARALLEL the two sets may be on different sides; no pose rests on such lines.
    skewed = (sines(own) > 0.15) | ~(lines & lines.mT)
    assert found[skewed].all()


def test_other_lengths_and_angles_do_not_agree(rng):
    one, two = drawn(50, rng), drawn(50, rng)
    found = agreement(Invariants.of(one), Invariants.of(two), 50, len(WORD))
    upper = torch.triu_indices(len(WORD), len(WORD), 1)
    assert not found[:, *upper].any()


def test_an_element_that_is_not_finite_agrees_with_nothing_and_leaves_the_others(rng):
    own = drawn(3, rng)
    other = moved(poses(3, rng=rng), own)
    other.point[1, 2] = torch.nan
    found = agreement(Invariants.of(own), Invariants.of(other), 3, len(WORD))
    expected = torch.ones_like(found)
    expected[1, 2, :2] = expected[1, :2, 2] = expected[1, 2, 2:5] = expected[1, 2:5, 2] = False
    assert_close(found[[0, 2]], expected[[0, 2]])
    assert not found[1][~expected[1]].any()


def test_dtype_follows_the_elements(rng):
    found = Invariants.of(single(drawn(2, rng)))
    for name in ("angle", "distance", "angle_variance", "distance_variance"):
        assert getattr(found, name).dtype == torch.float32
