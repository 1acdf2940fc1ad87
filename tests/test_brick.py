import json
import math
import subprocess
import sys
from itertools import combinations, permutations, product
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from torchcal.demo import brick
from torchcal.geometry import se3

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "brick_experiment.py"


def plain_oracle(C: np.ndarray) -> tuple[float, float]:
    """Support of every motion that maps three vertexes onto three, found by least squares."""
    p = brick.brick_model().point.numpy()
    supports: dict[tuple[int, ...], int] = {}
    for own, partner in product(combinations(range(8), 3), permutations(range(8), 3)):
        a, b = p[list(own)], p[list(partner)]
        sides = [np.linalg.norm(x - np.roll(x, 1, 0), axis=1) for x in (a, b)]
        if np.abs(sides[0] - sides[1]).max() < 1e-9:
            supports.update(_support_of(C, p, a, b))
    best = max(supports.values())
    tied = [key for key, value in supports.items() if value == best]
    right = {key: value for key, value in supports.items() if -1 not in key}
    best_right = [key for key, value in right.items() if value == max(right.values())]
    return (
        sum(-1 not in key for key in tied) / len(tied),
        sum(key == tuple(range(8)) for key in best_right) / len(best_right),
    )


def _support_of(
    C: np.ndarray, p: np.ndarray, a: np.ndarray, b: np.ndarray
) -> dict[tuple[int, ...], int]:
    U, _, Vt = np.linalg.svd((b - b.mean(0)).T @ (a - a.mean(0)))
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    moved = (p - a.mean(0)) @ R.T + b.mean(0)
    near = np.linalg.norm(moved[:, None] - p[None], axis=-1) < 1e-6
    key = tuple(int(row.argmax()) if row.any() else -1 for row in near)
    return {key: int((C & near).sum())}


def test_the_oracle_counts_as_a_plain_one_does(rng):
    C = torch.rand(4, 8, 8, generator=rng) < 0.5
    found = brick.oracle(C)
    for i in range(4):
        together, alone = plain_oracle(C[i].numpy())
        assert float(found.absolute[i]) == pytest.approx(alone)
        assert float(found.modulo_symmetry[i]) == pytest.approx(together)


def test_three_vertexes_coincide_after_a_hundred_motions():
    counts = brick._coincidences().sum((1, 2)).bincount()
    # Four turns map all; four vertexes of a face or of a diagonal section map onto four others.
    assert counts.tolist() == [0, 0, 0, 32, 64, 0, 0, 0, 4]


def test_symmetries_map_the_brick_onto_itself():
    p = brick.brick_model().point
    for S in brick.symmetries():
        moved = se3.transform(S, p)
        assert (torch.cdist(moved, p) < 1e-12).sum() == 8
        assert_close(torch.linalg.det(S), torch.ones((), dtype=torch.float64))


def test_the_least_errors_are_those_by_hand():
    variance = brick.cramer_rao().diagonal()
    assert_close(float(variance[:3].sum().sqrt()), 0.01 * math.sqrt(3 / 8))
    w, d, h = brick.SIZE
    lever = [d**2 + h**2, w**2 + h**2, w**2 + d**2]  # eight vertexes, a quarter of each square
    assert_close(
        float(variance[3:].sum().sqrt()), 0.01 * math.sqrt(sum(1 / (2 * x) for x in lever))
    )


@pytest.mark.parametrize("protocol", ["all-pairs", "nearest"])
def test_half_of_all_pairs_are_candidates(protocol, rng):
    C = brick.draw_trials(2000, protocol, generator=rng).candidates
    assert_close(C.double().mean(0), torch.full((8, 8), 0.5).double(), rtol=0, atol=0.05)


def test_one_to_one_gives_every_measured_vertex_one_candidate(rng):
    C = brick.draw_trials(2000, "one-to-one", generator=rng).candidates
    assert C.sum(1).eq(1).all()
    assert float(C.diagonal(dim1=1, dim2=2).double().mean()) == pytest.approx(0.5, abs=0.02)
    wrong = C.double().mean(0)[~torch.eye(8, dtype=torch.bool)]
    assert_close(wrong, torch.full_like(wrong, 1 / 14), rtol=0, atol=0.03)


def test_measured_vertexes_scatter_as_they_say(rng):
    trials = brick.draw_trials(3000, "all-pairs", generator=rng)
    exact = se3.transform(trials.T_measured_brick, brick.brick_model().point)
    scatter = torch.cov((trials.measured.point - exact).flatten(0, 1).T)
    assert_close(scatter, trials.measured.covariance[0, 0, :3, :3], rtol=0, atol=5e-6)


def test_the_script_writes_what_it_prints(tmp_path):
    file = tmp_path / "result.json"
    options = "--trials 30 --protocol one-to-one --seed 3 --restarts 5"
    answer = subprocess.run(
        [sys.executable, str(SCRIPT), *options.split(), "--json", str(file)],
        capture_output=True,
        text=True,
        check=True,
    )
    result = json.loads(file.read_text())
    assert result == json.loads(answer.stdout)
    assert result["success_modulo_symmetry"] == 1.0
    assert result["searches_mean"] > 1.0
    assert result["position_rms_m"] < 0.01
    assert result["paper"]["success"] == 0.973
