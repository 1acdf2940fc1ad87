"""Odd, bad and empty problems of elements among good ones."""

import math

import pytest
import torch
from element_problems import ALL_EIGHT, find, generator, room
from torch.testing import assert_close

import torchcal
from torchcal import Elements, ElementSearch, ElementStatus
from torchcal.demo import brick
from torchcal.geometry import se3


def test_bad_problems_leave_their_neighbours_bit_for_bit_as_they_were(rng):
    trials = brick.draw_trials(12, "all-pairs", generator=rng)
    expected = find(trials)
    point, C = trials.measured.point.clone(), trials.candidates.clone()
    point[2, 3], point[5], C[7] = torch.nan, 0.0, False
    covariance = trials.measured.covariance.clone()
    covariance[9, 1, :3, :3] = torch.ones(3, 3)  # singular
    bad = brick.BrickTrials(
        T_measured_brick=trials.T_measured_brick,
        measured=Elements(
            kind=trials.measured.kind,
            point=point,
            direction=trials.measured.direction,
            covariance=covariance,
        ),
        candidates=C,
    )
    found = find(bad)
    good = [0, 1, 3, 4, 6, 8, 10, 11]
    assert_close(found.T_measured_model[good], expected.T_measured_model[good], rtol=0, atol=0)
    assert_close(found.covariance[good], expected.covariance[good], rtol=0, atol=0)
    assert found.status[5] == ElementStatus.FAILED
    assert found.explained[2] == 7
    assert found.explained[7] == 8  # found again without any candidate


def test_a_problem_alone_gets_the_pose_it_gets_in_a_batch(rng):
    trials = brick.draw_trials(6, "all-pairs", generator=rng)
    together = find(trials)
    for i in range(6):
        alone = torchcal.find_element_poses(
            brick.brick_model(),
            trials.measured[slice(i, i + 1)],
            trials.candidates[i : i + 1],
            generator=generator(),
            search=ALL_EIGHT,
        )
        assert_close(alone.T_measured_model[0], together.T_measured_model[i], rtol=0, atol=1e-12)


def test_chunks_do_not_change_the_answer(rng):
    trials = brick.draw_trials(20, "all-pairs", generator=rng)
    whole, parts = find(trials), find(trials, search=ElementSearch(enough=1.0, chunk=6))
    assert_close(parts.T_measured_model, whole.T_measured_model, rtol=0, atol=1e-12)
    assert_close(parts.rivals.batch, whole.rivals.batch)


def test_batches_keep_their_shape_and_dtype(rng):
    trials = brick.draw_trials(6, "all-pairs", generator=rng)

    def shaped(values: torch.Tensor) -> torch.Tensor:
        values = values.float() if values.is_floating_point() else values
        return values.reshape(2, 3, *values.shape[1:])

    poses = torchcal.find_element_poses(
        brick.brick_model()._map(lambda v: v.float() if v.is_floating_point() else v),
        trials.measured._map(shaped),
        trials.candidates.view(2, 3, 8, 8),
        generator=generator(),
        search=ALL_EIGHT,
    )
    assert poses.T_measured_model.shape == (2, 3, 4, 4)
    assert poses.T_measured_model.dtype == poses.covariance.dtype == torch.float32
    twists = brick.errors(poses.T_measured_model.double().flatten(0, 1), trials.T_measured_brick)
    assert brick.are_successes(twists).any(-1).all()


def test_points_on_a_line_leave_a_turn_unknown():
    model = Elements.points(torch.tensor([[x, 0.0, 0.0] for x in (0, 1, 3, 7)]).double())
    measured = Elements.points(
        model.point[None] + 1.0, 1e-4 * torch.eye(3).double().expand(1, 4, 3, 3)
    )
    poses = torchcal.find_element_poses(
        model, measured, torch.eye(4, dtype=torch.bool)[None], generator=generator()
    )
    assert poses.explained[0] == 4
    assert poses.rank[0] == 5
    assert poses.status[0] == ElementStatus.UNOBSERVABLE
    assert poses.covariance.isnan().all()


def test_without_restarts_a_brick_without_candidates_is_not_found(rng):
    trials = brick.draw_trials(3, "all-pairs", generator=rng)
    none = torch.zeros_like(trials.candidates)
    poses = torchcal.find_element_poses(
        brick.brick_model(),
        trials.measured,
        none,
        generator=generator(),
        search=ElementSearch(restarts=0),
    )
    assert poses.status.eq(ElementStatus.FAILED).all()
    assert poses.T_measured_model.isnan().all()
    assert poses.searches.eq(1).all()


def test_mistakes_are_named(rng):
    trials = brick.draw_trials(3, "all-pairs", generator=rng)
    with pytest.raises(ValueError, match=r"\(8, 7\).*8 elements of the model and 8 measured"):
        torchcal.find_element_poses(
            brick.brick_model(), trials.measured, trials.candidates[..., :7], generator=rng
        )
    with pytest.raises(ValueError, match="without a covariance"):
        torchcal.find_element_poses(
            brick.brick_model(),
            Elements.points(trials.measured.point),
            trials.candidates,
            generator=rng,
        )


def test_unrelated_points_are_never_converged(rng):
    model = Elements.points(0.5 * torch.rand(8, 3, generator=rng, dtype=torch.float64))
    measured = Elements.points(
        0.5 * torch.rand(30, 8, 3, generator=rng, dtype=torch.float64),
        1e-4 * torch.eye(3).double().expand(30, 8, 3, 3),
    )
    poses = torchcal.find_element_poses(
        model, measured, torch.ones(30, 8, 8, dtype=torch.bool), generator=generator()
    )
    assert poses.status.eq(ElementStatus.FAILED).all()


def test_coordinates_far_from_the_origin_lose_nothing(rng):
    trials = brick.draw_trials(20, "all-pairs", generator=rng)
    near = find(trials)
    away = torch.tensor([3e6, -2e6, 5e6], dtype=torch.float64)
    model = Elements.points(brick.brick_model().point + away)
    far = torchcal.find_element_poses(
        model, trials.measured, trials.candidates, generator=generator(), search=ALL_EIGHT
    )
    assert_close(far.status, near.status)
    moved = se3.transform(far.T_measured_model, model.point)
    expected = se3.transform(near.T_measured_model, brick.brick_model().point)
    assert_close(moved, expected, rtol=0, atol=1e-6)


def test_one_problem_without_a_batch_and_no_problems(rng):
    trials = brick.draw_trials(1, "all-pairs", generator=rng)
    one = torchcal.find_element_poses(
        brick.brick_model(),
        trials.measured._map(lambda values: values[0]),
        trials.candidates[0],
        generator=generator(),
        search=ALL_EIGHT,
    )
    assert one.T_measured_model.shape == (4, 4)
    assert one.explained == 8
    none = torchcal.find_element_poses(
        brick.brick_model(), trials.measured[:0], trials.candidates[:0], generator=generator()
    )
    assert none.status.shape == (0,)


def test_no_kind_in_common_is_failed(rng):
    points = Elements.points(torch.rand(4, 3, generator=rng, dtype=torch.float64))
    _, measured, _ = room(rng, 3)
    lines = measured._map(lambda values: values[:, 3:7])
    C = torch.ones(3, 4, 4, dtype=torch.bool)
    poses = torchcal.find_element_poses(points, lines, C, generator=generator())
    assert poses.status.eq(ElementStatus.FAILED).all()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"chunk": 0}, "chunk is 0"),
        ({"sets": -1}, "sets is -1"),
        ({"enough": math.nan}, "enough is nan"),
        ({"least_cutoff": math.nan}, "least_cutoff is nan"),
    ],
)
def test_settings_out_of_range_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        ElementSearch(**options)
