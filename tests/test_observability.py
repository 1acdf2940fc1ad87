"""What a wall leaves open and a corner of a room does not."""

from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import EYE, twist
from torch import Tensor

from torchcal.calibrate.observability import (
    MOST_NAMED,
    poses_are_told,
    sentences,
    sparse_basis,
    unobservable_directions,
)
from torchcal.calibrate.observation import observe
from torchcal.calibrate.parameters import Parameters
from torchcal.calibrate.pipeline import build_job_scene
from torchcal.calibrate.range_fit import RangeFit
from torchcal.geometry import robust
from torchcal.model.job import Job
from torchcal.solve.gauss_newton import covariance

IMAGE = torch.ones(48, 64, dtype=torch.float64)


def job_with(mesh) -> Job:
    """One body, seen without noise by a wide beam (so that no pixel is left out)."""
    job = recordings.hand_held(
        recordings.sensor(beam=3),
        [EYE],
        error=torch.zeros(6, dtype=torch.float64),
        real={"thing": mesh},
    )
    return replace(job, world=recordings.world_of({"thing": mesh}))


def posterior(job: Job) -> tuple[Tensor, Parameters]:
    """P of eq. 3 at the nominal pose, which is the true one."""
    scene = build_job_scene(job)
    parameters = Parameters.of(job, scene)
    fit = RangeFit(
        observation=observe(job),
        surface=scene.surface,
        parameters=parameters,
        cutoff=robust.EFFICIENT,
        drift=None,
    )
    return covariance(fit.evaluate(parameters.nominal[None]).information[0]), parameters


def told(P: Tensor, parameters: Parameters) -> bool:
    return poses_are_told(P, parameters, parameters.pose_jacobians(parameters.nominal))


def test_a_wall_leaves_shifts_along_it_and_the_turn_about_its_normal():
    P, parameters = posterior(job_with(scenes.wall(2.0)))
    directions = unobservable_directions(P, parameters)
    assert len(directions) == 3
    words = " ".join(direction.words for direction in directions)
    for named in ("shift of the sensor along x", "shift of the sensor along y", "sensor about z"):
        assert named in words
    for told_of in ("along z", "about x", "about y"):
        assert told_of not in words
    span = torch.stack([direction.vector for direction in directions])
    assert parameters.names == ("base.x", "base.y", "base.z", "base.rx", "base.ry", "base.rz")
    # They span x, y and rz: nothing of the other three axes is in them.
    assert float(span[:, 2:5].abs().max()) < 1e-6  # rounding
    torch.testing.assert_close(span @ span.mT, torch.eye(3, dtype=span.dtype), atol=1e-9, rtol=0)
    assert not told(P, parameters)


def test_a_turned_wall_is_named_by_the_axes_it_lies_along():
    # The wall x = 2, seen by a sensor that looks along x; the base's axes are the sensor's.
    job = job_with(scenes.turned(scenes.wall(0.0), (0.0, 0.0, 2.0), (0.4, 0.0, 0.0)))
    P, parameters = posterior(job)
    directions = unobservable_directions(P, parameters)
    assert len(directions) == 3
    span = torch.stack([direction.vector for direction in directions])
    normal = torch.tensor([0.0, -torch.sin(torch.tensor(0.4)), torch.cos(torch.tensor(0.4))])
    normal = normal.to(span)
    # Shifts and turns have the same prior, so that directions are those of space.
    assert (
        float((span[:, :3] @ normal).abs().max()) < 1e-6
    )  # rounding of the single-precision normal


def test_a_corner_of_a_room_tells_everything():
    P, parameters = posterior(job_with(recordings.room()["room"]))
    assert unobservable_directions(P, parameters) == ()
    assert told(P, parameters)


def test_the_prior_alone_tells_nothing():
    _, parameters = posterior(job_with(scenes.wall(2.0)))
    P = torch.diag(parameters.prior_sigma.square())
    directions = unobservable_directions(P, parameters)
    assert len(directions) == 6
    assert sentences(directions) == (
        "the whole pose of the sensor cannot be told from these images",
    )
    assert not told(P, parameters)


def test_all_shifts_are_named_as_one():
    _, parameters = posterior(job_with(scenes.wall(2.0)))
    P = torch.diag((parameters.prior_sigma * twist(1, 1, 1, 0.1, 0.1, 1)).square())
    assert sentences(unobservable_directions(P, parameters)) == (
        "any shift of the sensor cannot be told from these images",
        "a turn of the sensor about z cannot be told from these images",
    )


def frames_of_their_own(count: int) -> Job:
    poses = [recordings.pose(0.1 * k, 0.0, -0.1 * k, 0.0, 0.1 * k, 0.0) for k in range(count)]
    frames = [recordings.frame_of(IMAGE, T_world_sensor=T) for T in poses]
    return replace(job_with(scenes.wall(2.0)), frames=tuple(frames), frame_poses=recordings.prior())


def test_a_shared_pose_and_the_poses_of_the_frames_are_the_same_thing():
    job = frames_of_their_own(3)
    parameters = Parameters.of(job, build_job_scene(job))
    J = parameters.pose_jacobians(parameters.nominal)
    precision = torch.diag(parameters.prior_sigma.square().reciprocal())
    P = torch.linalg.inv(precision + 1e8 * (J.mT @ J).sum(0))  # every pose is told to 0.1 mm
    directions = unobservable_directions(P, parameters)
    assert len(directions) == 6
    assert sentences(directions) == (
        "the whole pose of the sensor in all frames and the sensor's own pose in each frame cannot "
        "be told apart in these images",
    )


def test_what_is_open_in_every_frame_is_said_once():
    job = replace(frames_of_their_own(3), base=None)
    parameters = Parameters.of(job, build_job_scene(job))
    left = twist(1, 0.1, 0.1, 0.1, 0.1, 0.1).repeat(3)
    P = torch.diag((parameters.prior_sigma * left).square())
    directions = unobservable_directions(P, parameters)
    assert len(directions) == 3
    assert sentences(directions) == (
        "a shift of the sensor in each frame along x cannot be told from these images",
    )
    only_first = torch.where(torch.arange(18) < 6, left, 0.1)
    P = torch.diag((parameters.prior_sigma * only_first).square())
    assert sentences(unobservable_directions(P, parameters)) == (
        "a shift of the sensor in frame 1 along x cannot be told from these images",
    )


def test_only_the_largest_parts_of_a_direction_are_named():
    _, parameters = posterior(job_with(scenes.wall(2.0)))
    open_one = torch.nn.functional.normalize(twist(1.0, 0.9, 0.8, 0.7, 0.5, 0.5), dim=0)
    information = 1e4 * (torch.eye(6).double() - torch.outer(open_one, open_one))
    scale = parameters.prior_sigma
    P = torch.linalg.inv(torch.eye(6) + information) * scale[:, None] * scale
    (direction,) = unobservable_directions(P, parameters)
    assert direction.words.count(" of the sensor ") == MOST_NAMED
    for named in ("along x", "along y", "along z", "about x", "and 2 smaller parts cannot"):
        assert named in direction.words
    torch.testing.assert_close(direction.vector, open_one, rtol=0, atol=1e-6)


def test_a_sparse_basis_finds_the_few_parts_that_a_mixture_hides(rng):
    few = torch.zeros(4, 12, dtype=torch.float64)
    few[0, 1] = 1.0
    few[1, [2, 7]] = torch.tensor([0.8, -0.6], dtype=torch.float64)
    few[2, [3, 4, 5]] = torch.tensor([3.0, 1.0, -1.0], dtype=torch.float64) / 11.0**0.5
    few[3, [9, 11]] = 0.5**0.5
    mixed = torch.linalg.qr(torch.randn(4, 4, generator=rng, dtype=torch.float64))[0] @ few
    found = sparse_basis(mixed)
    torch.testing.assert_close(found.abs(), few.abs(), rtol=0, atol=1e-4)
    torch.testing.assert_close(found @ found.mT, torch.eye(4).double(), rtol=0, atol=1e-12)
    # The same space: nothing is lost and nothing is added.
    torch.testing.assert_close(found.mT @ found, few.mT @ few, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("share", "expected"), [(0.45, True), (0.55, False)])
def test_half_of_the_priors_sigma_is_the_limit(share, expected):
    _, parameters = posterior(job_with(scenes.wall(2.0)))
    P = torch.diag((0.1 * parameters.prior_sigma).square())
    P[3, 3] = (share * parameters.prior_sigma[3]).square()
    assert told(P, parameters) is expected
    directions = unobservable_directions(P, parameters)
    assert [direction.words for direction in directions] == (
        [] if expected else ["a turn of the sensor about x cannot be told from these images"]
    )


def test_directions_that_do_not_move_the_sensor_leave_its_pose_told(tmp_path):
    robot = recordings.arm(tmp_path)
    joints = torch.zeros(2, dtype=torch.float64)
    job = replace(
        job_with(scenes.wall(2.0)),
        robot=robot,
        link="tool",
        frames=(recordings.frame_of(IMAGE, joints=joints),),
        mount=recordings.prior(),
    )
    parameters = Parameters.of(job, build_job_scene(job))
    J = parameters.pose_jacobians(parameters.nominal)
    # One frame that tells the sensor's pose to 0.1 mm, and so only a sum of base and mount.
    precision = parameters.prior_sigma.square().reciprocal()
    P = torch.linalg.inv(torch.diag(precision) + 1e8 * J[0].mT @ J[0])
    assert poses_are_told(P, parameters, J)
    directions = unobservable_directions(P, parameters)
    assert len(directions) == 6
    for direction in directions:
        assert "base" in direction.words
        assert "sensor's mount" in direction.words


def test_without_unknowns_nothing_is_open():
    job = replace(job_with(scenes.wall(2.0)), base=None)
    parameters = Parameters.of(job, build_job_scene(job))
    P = torch.zeros(0, 0, dtype=torch.float64)
    assert unobservable_directions(P, parameters) == ()
    assert told(P, parameters)
