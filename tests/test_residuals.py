import math

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
    single,
    units,
    with_covariance,
)
from torch import Tensor
from torch.testing import assert_close

from torchcal.geometry import se3
from torchcal.match.elements import Elements, Kind
from torchcal.match.residuals import PairResiduals, Whitening

WORD = "PPLLEE"


def drawn(members: int, rng: torch.Generator, word: str = WORD) -> Elements:
    count = len(word)
    return elements(word, normal(members, count, 3, rng=rng), units(members, count, rng=rng))


def measured_from(exact: Elements, rng: torch.Generator, sigma: float = 0.01) -> Elements:
    return with_covariance(exact, covariances(*exact.kind.shape, rng=rng, sigma=sigma))


def every(own: PairResiduals) -> Tensor:
    return torch.arange(len(own.kind))


def of_all(own: PairResiduals, T: Tensor) -> Tensor:
    return own.residual(T, every(own))


@pytest.mark.parametrize("word", ["P", "L", "E", "PLE"])
def test_residuals_of_measured_elements_have_unit_covariance(word, rng):
    members, count = 20_000, len(word)
    model = drawn(1, rng, word).expand(members, 1).flattened()
    model = Elements(
        kind=model.kind.reshape(members, count),
        point=model.point,
        direction=model.direction,
        covariance=model.covariance,
    )
    T = poses(1, rng=rng).expand(members, 4, 4)
    # So small that a turn's square is nothing.
    covariance = covariances(1, count, rng=rng, sigma=1e-4)
    measured = noisy(with_covariance(moved(T, model), covariance), rng=rng)
    own = residuals_of(model, measured, one_to_one(members, count))
    present = own.present[0].flatten()
    v = of_all(own, T).flatten(1)[:, present]
    assert int(present.sum()) == sum({"P": 3, "L": 4, "E": 3}[letter] for letter in word)
    # A covariance of 20,000 draws scatters by 0.007 to 0.01.
    assert_close(v.mean(0), torch.zeros_like(v[0]), rtol=0, atol=0.035)
    assert_close(v.mT.cov(), torch.eye(v.shape[1], dtype=torch.float64), rtol=0, atol=0.05)


def basis(direction: Tensor) -> Tensor:
    """Any two rows across a direction."""
    return torch.linalg.svd(direction[None])[2][1:]


def by_hand(own: Elements, other: Elements, i: int) -> float:
    """The squared length of v between one predicted and one measured element."""
    kind = int(other.kind[i])
    x, q, e, n = own.point[i], other.point[i], own.direction[i], other.direction[i]
    B = basis(n)
    if kind == Kind.POINT:
        errors, rows = x - q, torch.eye(3, 6, dtype=torch.float64)
    else:
        e = -e if kind == Kind.LINE and n @ e < 0 else e
        sideways = B @ e
        turn = sideways / sideways.norm() * (e - n).norm()
        if kind == Kind.LINE:
            met = x + e * (n @ (q - x)) / (n @ e)
            position, across = B @ (met - q), B
        else:
            position, across = (e @ (x - q) / (e @ n))[None], n[None]
        errors = torch.cat([position, turn])
        rows = torch.block_diag(across, B)
    covariance = rows @ other.covariance[i] @ rows.mT
    return float(errors @ torch.linalg.solve(covariance, errors))


def test_the_length_of_v_is_that_of_plain_geometry_in_any_axes(rng):
    model, T = drawn(5, rng), poses(5, rng=rng)
    measured = measured_from(moved(poses(5, rng=rng), model), rng, sigma=0.5)
    own = residuals_of(model, measured, one_to_one(5, 6))
    v = of_all(own, T).square().sum(-1)
    predicted = moved(T, model)
    for member in range(5):
        rows = torch.tensor(member)
        for i in range(6):
            expected = by_hand(predicted[rows], measured[rows], i)
            assert float(v[member, i]) == pytest.approx(expected, rel=1e-8)


def test_at_the_true_pose_there_is_no_residual(rng):
    model, T = drawn(20, rng), poses(20, rng=rng)
    own = residuals_of(model, measured_from(moved(T, model), rng), one_to_one(20, 6))
    # 1e-15 m in units of about 1 cm, 10 where an axis is known ten times better.
    v = of_all(own, T)
    assert_close(v, torch.zeros_like(v), rtol=0, atol=1e-10)


def test_another_point_or_sense_of_the_model_is_the_same_line_and_plane(rng):
    model, T = drawn(20, rng), poses(20, rng=rng, size=0.2)
    measured = measured_from(model, rng, sigma=0.5)
    is_line = (model.kind == Kind.LINE)[..., None]
    is_plane = (model.kind == Kind.PLANE)[..., None]
    along = normal(20, 6, 1, rng=rng) * model.direction
    within = torch.linalg.cross(model.direction, normal(20, 6, 3, rng=rng))
    other = Elements(
        kind=model.kind,
        point=model.point + torch.where(is_line, along, 0.0) + torch.where(is_plane, within, 0.0),
        direction=torch.where(is_line, -model.direction, model.direction),
        covariance=model.covariance,
    )
    C = one_to_one(20, 6)
    one, two = residuals_of(model, measured, C), residuals_of(other, measured, C)
    found, expected = two.linearise(T, every(two)), one.linearise(T, every(one))
    for a, b in zip(found, expected, strict=True):
        assert_close(a, b, rtol=1e-9, atol=1e-9)
    assert float((other.point - model.point)[:, 2:].norm(dim=-1).min()) > 0


@pytest.mark.parametrize("kind", [Elements.lines, Elements.planes])
@pytest.mark.parametrize("angle", [1e-6, 0.3, 1.5])
def test_a_turn_counts_the_chord_in_standard_deviations(kind, angle):
    X, _, Z = torch.eye(3, dtype=torch.float64)
    covariance = torch.diag(torch.tensor([1.0, 1, 1, 0.01, 0.01, 0.01], dtype=torch.float64))
    point = torch.zeros(1, 1, 3, dtype=torch.float64)
    tilted = math.cos(angle) * Z + math.sin(angle) * X
    model, measured = kind(point, tilted.expand(1, 1, 3)), kind(point, Z.expand(1, 1, 3))
    measured = with_covariance(measured, covariance)
    v = of_all(residuals_of(model, measured, one_to_one(1, 1)), torch.eye(4)[None].double())
    assert float(v.norm()) == pytest.approx(2 * math.sin(angle / 2) / 0.1, rel=1e-9)


def test_planes_seen_from_behind_are_twice_the_chord_of_perpendicular_ones_apart():
    point = torch.zeros(1, 1, 3, dtype=torch.float64)
    Z = torch.tensor([[[0.0, 0, 1]]], dtype=torch.float64)
    behind = torch.tensor([[[1e-3, 0, -1]]], dtype=torch.float64)
    measured = with_covariance(Elements.planes(point, Z), torch.eye(6, dtype=torch.float64))
    own = residuals_of(Elements.planes(point, behind), measured, one_to_one(1, 1))
    v = of_all(own, torch.eye(4, dtype=torch.float64)[None])
    assert float(v.norm()) == pytest.approx(2.0, rel=1e-6)


def test_padding_and_missing_components_are_marked_absent(rng):
    model, measured = drawn(2, rng), measured_from(drawn(2, rng), rng)
    C = one_to_one(2, 6).clone()
    C[1, 3:] = False
    own = residuals_of(model, measured, C)
    table = [[1, 1, 1, 0, 0]] * 2 + [[1, 1, 0, 1, 1]] * 2 + [[0, 0, 1, 1, 1]] * 2
    expected = torch.tensor([table, table[:3] + [[0] * 5] * 3]).bool()
    assert_close(own.present, expected)
    v = of_all(own, poses(2, rng=rng))
    assert v[~own.present & C.any(-1)[..., None]].eq(0).all()


def test_points_alone_have_three_components(rng):
    word = "PPP"
    own = residuals_of(
        drawn(2, rng, word), measured_from(drawn(2, rng, word), rng), one_to_one(2, 3)
    )
    assert own.present.shape == (2, 3, 3)
    assert own.present.all()


def test_points_are_the_same_among_lines_and_alone(rng):
    model, T = drawn(4, rng), poses(4, rng=rng)
    measured = measured_from(drawn(4, rng), rng)
    mixed = of_all(residuals_of(model, measured, one_to_one(4, 6)), T)[:, :2, :3]

    def first(own: Elements) -> Elements:
        return Elements(
            kind=own.kind[:, :2],
            point=own.point[:, :2],
            direction=own.direction[:, :2],
            covariance=own.covariance[:, :2],
        )

    alone = of_all(residuals_of(first(model), first(measured), one_to_one(4, 2)), T)
    assert_close(mixed, alone)


@pytest.mark.parametrize("bad", [torch.nan, -1.0, 0.0], ids=["nan", "negative", "zero"])
def test_covariances_that_are_not_definite_are_nan_and_leave_the_others(bad, rng):
    measured = measured_from(drawn(3, rng), rng)
    expected = Whitening.of(measured).root
    measured.covariance[1, [0, 3, 5]] = bad * torch.eye(6, dtype=torch.float64)
    found = Whitening.of(measured).root
    assert found[1, [0, 3, 5]].isnan().flatten(1).any(1).all()
    expected[1, [0, 3, 5]] = found[1, [0, 3, 5]]
    assert_close(found, expected, rtol=0, atol=0, equal_nan=True)


def test_what_is_not_across_a_line_or_along_a_normal_does_not_matter(rng):
    model, T = drawn(4, rng, "LE"), poses(4, rng=rng)
    measured = measured_from(drawn(4, rng, "LE"), rng)
    expected = of_all(residuals_of(model, measured, one_to_one(4, 2)), T)
    n = measured.direction[..., None]
    along = n @ n.mT
    free = torch.stack([along[:, 0], torch.eye(3, dtype=torch.float64) - along[:, 1]], 1)
    measured.covariance[..., :3, :3] += 9.0 * free
    measured.covariance[..., 3:, 3:] += 9.0 * along
    found = of_all(residuals_of(model, measured, one_to_one(4, 2)), T)
    # Numbers of 9 are cancelled in variances of 1e-4.
    assert_close(found, expected, rtol=1e-8, atol=1e-8)


def test_only_the_problems_that_are_asked_for_are_evaluated(rng):
    model, T = drawn(5, rng), poses(5, rng=rng)
    own = residuals_of(model, measured_from(drawn(5, rng), rng), one_to_one(5, 6))
    some = torch.tensor([3, 1])
    for part, whole in zip(own.linearise(T[some], some), own.linearise(T, every(own)), strict=True):
        assert_close(part, whole[some])


def test_several_problems_may_share_a_member(rng):
    model, measured = drawn(2, rng), measured_from(drawn(2, rng), rng)
    T = poses(3, rng=rng)
    batch = torch.tensor([1, 1, 0])
    shared = residuals_of(model, measured, one_to_one(2, 6))
    repeated = residuals_of(model[batch], measured[batch], one_to_one(3, 6))
    assert_close(of_all(repeated, T), shared.residual(T, batch))


def test_dtype_follows_and_nothing_gives_nothing(rng):
    model, measured = single(drawn(2, rng)), single(measured_from(drawn(2, rng), rng))
    own = residuals_of(model, measured, one_to_one(2, 6))
    v, A = own.linearise(se3.exp(torch.zeros(2, 6)), every(own))
    assert (v.dtype, A.dtype) == (torch.float32, torch.float32)
    none = residuals_of(model, measured, torch.zeros(2, 6, 6, dtype=torch.bool))
    v, A = none.linearise(se3.exp(torch.zeros(2, 6)), every(none))
    assert (v.shape, A.shape) == ((2, 0, 5), (2, 0, 5, 6))
    nobody = own.linearise(torch.zeros(0, 4, 4), torch.zeros(0, dtype=torch.int64))
    assert nobody[1].shape == (0, 6, 5, 6)
