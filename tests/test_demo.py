"""The demo's job: what is said of it is true."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torchcal.demo import DemoTruth, cell, make_demo, raycast, recording, robot_folder
from torchcal.errors import TorchcalError
from torchcal.geometry import se3
from torchcal.model.read_job import read_job
from torchcal.model.robot import Robot, load_robot

WELL_VISIBLE = 5000  # pixels of 512 x 512


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> DemoTruth:
    return make_demo(tmp_path_factory.mktemp("demo"), seed=0)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot(robot_folder("arm") / "arm.urdf")


def visible(
    objects: tuple[cell.CellObject, ...], robot: Robot, truth: DemoTruth, posture: tuple[float, ...]
) -> dict[str, int]:
    """The number of pixels that show each object; the robot's own links as ``robot``."""
    view = recording.view_of(objects, robot, truth.T_world_base, posture)
    u, v = np.meshgrid(np.arange(512.0), np.arange(512.0))
    rays = recording.SENSOR.projection.rays(torch.from_numpy(u), torch.from_numpy(v)).numpy()
    _, face = raycast.cast(view, rays)
    ends = np.cumsum([len(each.mesh.faces) for each in objects])
    counts = np.bincount(np.searchsorted(ends, face[face >= 0], side="right"), minlength=len(ends))
    return dict(zip([*(each.name for each in objects), "robot"], counts.tolist(), strict=False))


def test_the_job_can_be_read(truth: DemoTruth):
    job = read_job(truth.job)
    assert job.world is not None
    assert {each.name for each in job.world.objects} == set(truth.objects)
    assert len(job.frames) == len(recording.POSTURES)
    assert job.sensor == recording.SENSOR
    assert job.robot is not None
    assert job.robot.joint_names == recording.JOINTS
    torch.testing.assert_close(job.T_world_base, recording.nominal_T_world_base())


def test_the_model_is_the_cell_without_what_was_added(truth: DemoTruth):
    world = read_job(truth.job).world
    assert world is not None
    read = {each.name: each for each in world.objects}
    for each in cell.modelled_objects():
        mesh = read[each.name].mesh.copy().apply_transform(read[each.name].T_world_object.numpy())
        # GLB holds single precision
        np.testing.assert_allclose(mesh.bounds, each.in_world().bounds, atol=1e-6)
        np.testing.assert_allclose(mesh.area, each.mesh.area, rtol=1e-5)
    assert cell.ADDED not in read
    assert cell.REMOVED in read
    assert {each.name for each in cell.real_objects()} ^ set(read) == {cell.ADDED, cell.REMOVED}


@pytest.mark.parametrize("seed", range(20))
def test_the_base_is_off_by_what_was_promised(seed: int):
    twist = recording.base_error(np.random.default_rng(seed))
    assert 0.03 <= np.linalg.norm(twist[:3]) <= 0.06
    assert 2.0 <= np.degrees(np.linalg.norm(twist[3:])) <= 3.0


def test_the_truth_is_the_nominal_base_moved_by_that_error(truth: DemoTruth):
    moved = se3.log(se3.inverse(recording.nominal_T_world_base()) @ truth.T_world_base).numpy()
    np.testing.assert_allclose(moved, recording.base_error(np.random.default_rng(0)), atol=1e-12)


def test_what_was_added_and_removed_is_well_visible_twice(truth: DemoTruth, robot: Robot):
    added, removed = (
        [visible(objects, robot, truth, posture)[name] for posture in recording.POSTURES]
        for objects, name in (
            (cell.real_objects(), cell.ADDED),
            (cell.modelled_objects(), cell.REMOVED),
        )
    )
    assert sum(count > WELL_VISIBLE for count in added) >= 2
    assert sum(count > WELL_VISIBLE for count in removed) >= 2


def test_every_image_shows_surfaces_at_two_to_six_metres(truth: DemoTruth):
    for frame in read_job(truth.job).frames:
        ranges = frame.image.range
        assert torch.isfinite(ranges).all()
        assert 2.0 < ranges.median() < 6.0
        assert ranges.max() - ranges.min() > 2.0


def test_the_images_are_the_prediction_with_noise(truth: DemoTruth, robot: Robot):
    posture = recording.POSTURES[0]
    view = recording.view_of(cell.real_objects(), robot, truth.T_world_base, posture)
    predicted = raycast.predict(view, recording.SENSOR.projection, recording.SENSOR.beam)
    residual = read_job(truth.job).frames[0].image.range.numpy() - predicted
    # four sigma of 262,144 pixels
    assert abs(residual.mean()) < 4.0 * 0.05 / 512
    assert abs(residual.std() / 0.05 - 1.0) < 4.0 / (2**0.5 * 512)


def test_a_seed_makes_the_same_files_again(
    truth: DemoTruth, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(recording, "POSTURES", recording.POSTURES[:1])
    told: list[tuple[str, float]] = []
    again = make_demo(tmp_path, seed=0, progress=lambda what, share: told.append((what, share)))
    other = make_demo(tmp_path / "other", seed=1)
    torch.testing.assert_close(again.T_world_base, truth.T_world_base, rtol=0, atol=0)
    for file in ("0001.png", "cell.glb"):
        assert (again.job.parent / file).read_bytes() == (truth.job.parent / file).read_bytes()
    assert (other.T_world_base - truth.T_world_base).abs().max() > 0.01
    assert [share for _, share in told] == [0.0, 0.0, 1.0]


def test_an_unknown_robot_lists_those_that_exist():
    with pytest.raises(TorchcalError, match="one of arm, rover"):
        robot_folder("snake")
