"""Poses from uncertain pairs of elements, against the truth and against what C can say."""

import math

import pytest
import torch
from torch.testing import assert_close

import torchcal
from torchcal import Elements, ElementSearch, ElementStatus
from torchcal.demo import brick
from torchcal.geometry import se3

ALL_EIGHT = ElementSearch(enough=1.0)


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(7)


def find(trials: brick.BrickTrials, **options) -> torchcal.ElementPoses:
    return torchcal.find_element_poses(
        brick.brick_model(),
        trials.measured,
        trials.candidates,
        **{"generator": generator(), "search": ALL_EIGHT, **options},
    )


def room(rng: torch.Generator, count: int = 60) -> tuple[Elements, Elements, torch.Tensor]:
    """Points, lines and planes of a room, measured with noise in ``count`` poses.

    Returns:
        The model, the measured elements in another order, and T_measured_model.
    """

    def unit(*shape: int) -> torch.Tensor:
        draw = torch.randn(*shape, 3, generator=rng, dtype=torch.float64)
        return torch.nn.functional.normalize(draw, dim=-1)

    def point(*shape: int) -> torch.Tensor:
        return 4 * torch.rand(*shape, 3, generator=rng, dtype=torch.float64) - 2

    model = Elements.join(
        Elements.points(point(3)),
        Elements.lines(point(4), unit(4)),
        Elements.planes(point(4), unit(4)),
    )
    T = se3.exp(torch.randn(count, 6, generator=rng, dtype=torch.float64))
    kind = model.kind.expand(count, -1)
    d = model.direction @ T[:, :3, :3].mT
    slide = torch.randn(count, 11, 3, generator=rng, dtype=torch.float64)
    along = (slide * d).sum(-1, keepdim=True) * d
    beside = torch.where((kind == 1)[..., None], along, slide - along)
    exact = se3.transform(T, model.point) + torch.where((kind == 0)[..., None], 0.0, beside)
    noise = torch.randn(count, 11, 6, generator=rng, dtype=torch.float64)
    noisy = exact + 0.01 * noise[..., :3]
    turned = torch.nn.functional.normalize(d + 0.005 * noise[..., 3:], dim=-1)
    sense = torch.where((kind == 1) & (noise[..., 0] > 0), -1.0, 1.0)[..., None]
    measured = Elements(
        kind=kind,
        point=noisy,
        direction=torch.where((kind == 0)[..., None], 0.0, sense * turned),
        covariance=torch.diag(torch.tensor([1e-4] * 3 + [2.5e-5] * 3).double()).expand(
            count, 11, 6, 6
        ),
    )
    return model, measured, T


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
