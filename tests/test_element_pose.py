"""Poses from uncertain pairs of elements, against the truth and against what C can say."""

import math

import pytest
import torch
from element_problems import find, generator, room
from torch.testing import assert_close

import torchcal
from torchcal import Elements, ElementSearch, ElementStatus
from torchcal.demo import brick
from torchcal.geometry import se3


@pytest.mark.parametrize("protocol", ["all-pairs", "one-to-one", "nearest"])
def test_every_brick_is_found_modulo_symmetry(protocol, rng):
    trials = brick.draw_trials(150, protocol, generator=rng)
    detect = torchcal.nearest_candidate if protocol == "nearest" else torchcal.every_candidate
    poses = find(trials, detect=detect)
    twists = brick.errors(poses.T_measured_model, trials.T_measured_brick)
    assert brick.are_successes(twists).any(-1).all()
    assert poses.explained.eq(8).all()
    assert poses.rank.eq(6).all()


def test_candidates_alone_give_what_the_oracle_says(rng):
    trials = brick.draw_trials(400, "all-pairs", generator=rng)
    tied = find(trials).from_candidates
    twists = brick.errors(tied.T, trials.T_measured_brick[tied.batch])
    right = brick.are_successes(twists).any(-1).double()
    zero = torch.zeros(400, dtype=torch.float64)
    share = zero.index_add(0, tied.batch, right) / zero.index_add(0, tied.batch, right + 1 - right)
    expected = brick.oracle(trials.candidates).modulo_symmetry.double()
    assert_close(share, expected, rtol=0, atol=1e-6)


def test_the_symmetric_pose_is_the_one_that_most_candidates_support(rng):
    trials = brick.draw_trials(200, "one-to-one", generator=rng)
    poses = find(trials)
    near = torch.cdist(
        se3.transform(
            trials.T_measured_brick[:, None] @ brick.symmetries(), brick.brick_model().point
        ),
        trials.measured.point[:, None],
    )
    support = ((near < 0.5) & trials.candidates[:, None]).sum((-1, -2))
    assert_close(poses.supported, support.amax(1))


@pytest.mark.parametrize("cutoff", [4.685, 3.0])
def test_errors_are_as_large_as_the_covariance_says(cutoff, rng):
    trials = brick.draw_trials(1000, "all-pairs", generator=rng)
    poses = find(trials, search=ElementSearch(enough=1.0, least_cutoff=cutoff))
    twists = brick.errors(poses.T_measured_model, trials.T_measured_brick)
    which = twists[..., 3:].norm(dim=-1).argmin(1)
    xi = twists[torch.arange(1000), which]
    nees = (xi * torch.linalg.solve(poses.covariance, xi)).sum(-1).mean() / 6
    spread = math.sqrt(2 / 6000)
    assert abs(float(nees) - 1) < 4 * spread
    if cutoff > 4:
        assert float(xi[:, :3].square().sum(-1).mean().sqrt()) < 0.0066
        assert float(xi[:, 3:].square().sum(-1).mean().sqrt()) < 0.00235


def test_points_lines_and_planes_with_wrong_candidates(rng):
    model, measured, T = room(rng)
    right = torch.eye(11, dtype=torch.bool) & (torch.rand(60, 11, 11, generator=rng) < 0.7)
    wrong = torch.rand(60, 11, 11, generator=rng) < 0.3
    poses = torchcal.find_element_poses(model, measured, right | wrong, generator=generator())
    xi = se3.log(se3.inverse(poses.T_measured_model) @ T)
    assert xi.norm(dim=-1).max() < 0.1
    assert poses.explained.eq(11).all()
    assert_close(poses.partner, torch.arange(11).expand(60, 11))
    nees = (xi * torch.linalg.solve(poses.covariance, xi)).sum(-1).mean() / 6
    assert abs(float(nees) - 1) < 4 * math.sqrt(2 / 360)


@pytest.mark.parametrize("kept", [[0, 1, 2], [3, 4, 5, 6], [7, 8, 9, 10], [0, 3, 4], [3, 7, 8]])
def test_few_elements_of_any_kind_are_enough(kept, rng):
    model, measured, T = room(rng, 20)
    some = torch.tensor(kept)
    model = model._map(lambda values: values[some])
    measured = measured._map(lambda values: values[:, some])
    C = torch.ones(20, len(kept), len(kept), dtype=torch.bool)
    poses = torchcal.find_element_poses(model, measured, C, generator=generator())
    right = se3.log(se3.inverse(poses.T_measured_model) @ T)
    normalised = (right * torch.linalg.solve(poses.covariance, right)).sum(-1)
    is_right = normalised < 50  # far in the tail of a chi-square of six
    rival = torch.zeros(20, dtype=torch.bool)
    rival[poses.rivals.batch] = True
    # Few elements may fit in another way as well; then the rivals say so.
    assert (is_right | rival).all()
    assert is_right.sum() >= 15


def test_equal_evidence_for_two_poses_is_ambiguous(rng):
    trials = brick.draw_trials(10, "all-pairs", generator=rng)
    every = brick.BrickTrials(
        T_measured_brick=trials.T_measured_brick,
        measured=trials.measured,
        candidates=torch.ones_like(trials.candidates),
    )
    poses = find(every)
    assert poses.status.eq(ElementStatus.AMBIGUOUS).all()
    assert poses.rivals.batch.bincount().tolist() == [3] * 10


@pytest.mark.parametrize("kept", [[3, 4], [0, 3]])
def test_lines_that_may_be_turned_are_ambiguous(kept, rng):
    model, measured, T = room(rng, 20)
    some = torch.tensor(kept)
    model, measured = model._map(lambda v: v[some]), measured._map(lambda v: v[:, some])
    C = torch.eye(2, dtype=torch.bool).expand(20, 2, 2)
    poses = torchcal.find_element_poses(model, measured, C, generator=generator())
    assert poses.status.eq(ElementStatus.AMBIGUOUS).all()
    every = torch.cat([poses.T_measured_model, poses.rivals.T])
    batch = torch.cat([torch.arange(20), poses.rivals.batch])
    near = se3.log(se3.inverse(every) @ T[batch]).norm(dim=-1) < 0.2
    assert batch[near].unique().tolist() == list(range(20))


def test_points_that_are_one_way_only_have_no_rivals(rng):
    model = Elements.points(4 * torch.rand(12, 3, generator=rng, dtype=torch.float64))
    measured = Elements.points(
        model.point + 0.01 * torch.randn(10, 12, 3, generator=rng, dtype=torch.float64),
        1e-4 * torch.eye(3).double().expand(10, 12, 3, 3),
    )
    poses = torchcal.find_element_poses(
        model, measured, torch.ones(10, 12, 12, dtype=torch.bool), generator=generator()
    )
    assert poses.status.eq(ElementStatus.CONVERGED).all()
    assert len(poses.rivals.batch) == 0
