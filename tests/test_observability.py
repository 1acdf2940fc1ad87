"""What a wall leaves open and a corner of a room does not."""

from dataclasses import replace

import pytest
import recordings
import scenes
import torch
from recordings import EYE
from torch import Tensor

from torchcal.calibrate.observability import poses_are_told, unobservable_directions
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
    assert len(unobservable_directions(P, parameters)) == 6
    assert not told(P, parameters)


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
