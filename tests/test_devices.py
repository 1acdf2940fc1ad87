"""On a GPU everything is found as on the CPU, and dtype and device follow the inputs."""

from dataclasses import replace

import pytest
import recordings
import scenes
import torch
import tracked_camera
from element_problems import find, generator
from moved import moved
from numpy.testing import assert_allclose
from recordings import EYE, pose, prior, twist
from test_reliability import refined
from torch import Tensor
from torch.testing import assert_close

import torchcal
from torchcal import Calibration, Pinhole, Prior, Site, Status, Tracked, Tracker, TrackStatus
from torchcal.calibrate import foresight, reliability
from torchcal.calibrate.anywhere import locate
from torchcal.demo import brick
from torchcal.geometry.projection import Projection
from torchcal.match.image.features import image_labels
from torchcal.model.job import Job

TINY = recordings.sensor(Pinhole(width=24, height=18, fx=20.6, fy=20.2, cx=11.7, cy=8.9))
SMALL = recordings.sensor(Pinhole(width=40, height=30, fx=34.0, fy=34.0, cx=19.5, cy=14.5))
LARGE = recordings.sensor(
    Pinhole(width=128, height=96, fx=110.0, fy=108.0, cx=62.4, cy=47.8), sigma=0.01, beam=5
)
OFF = twist(0.02, 0.01, -0.01, 0.01, 0.02, -0.01)
ROUNDING = 1e-5
"""m, rad: images are in single precision. Sigmas are a hundred times that."""


def same(found: Tensor, expected: Tensor, device: torch.device, atol: float = ROUNDING) -> None:
    """Of the same type and value, and on the device."""
    assert found.device == device
    assert_close(found.cpu(), expected, atol=atol, rtol=0.0, equal_nan=True)


@pytest.fixture
def crate(monkeypatch) -> None:
    """A room with nothing but the crate: that is quicker."""
    meshes = {name: recordings.room()[name] for name in ("room", "crate")}
    monkeypatch.setattr(recordings, "room", lambda: dict(meshes))


@pytest.fixture
def carried(crate, tmp_path, monkeypatch) -> Job:
    """A robot whose base, mount and joints are unknown."""
    monkeypatch.setattr(foresight, "VIEWS", 3)
    base, mount = pose(-0.3, 0.1, -0.5, 0.1, 0.2, 0.3), pose(0.3, 0.0, 0.1, 0.0, 0.3, 0.0)
    postures = [twist(0.2, -0.3), twist(-0.4, 0.1)]
    job = recordings.carried(recordings.arm(tmp_path), TINY, base, mount, postures)
    joints = {"nod": 0.02, "turn": 0.02}
    return replace(job, base=prior(0.05, 0.05), mount=prior(0.01, 0.01), joints=joints)


def calibrated(job: Job, *, estimate: bool = True) -> Calibration:
    return torchcal.calibrate(job, estimate=estimate, generator=generator())


def assert_same_calibration(job: Job, device: torch.device, *, estimate: bool = True) -> None:
    found = calibrated(moved(job, device), estimate=estimate)
    expected = calibrated(job, estimate=estimate)
    assert found.estimate.status == expected.estimate.status
    same(found.estimate.Ts_world_sensor, expected.estimate.Ts_world_sensor, device)
    same(found.estimate.covariance, expected.estimate.covariance, device)
    for name, T in expected.estimate.Ts_world_object.items():
        same(found.estimate.Ts_world_object[name], T, device)
    for frame, other in zip(found.comparisons, expected.comparisons, strict=True):
        differs = frame.label.cpu() != other.label
        # What is at a limit may fall on either side of it.
        assert float(differs.double().mean()) < 0.01
    for name, verdict in expected.update.verdicts.items():
        assert found.update.verdicts[name].verdict == verdict.verdict
    for item, other in zip(found.update.added, expected.update.added, strict=True):
        assert_allclose(item.mesh.bounds, other.mesh.bounds, atol=1e-3)


@pytest.mark.slow
def test_base_and_object_of_a_hand_held_sensor(device, crate):
    job = recordings.hand_held(TINY, [EYE], error=OFF)
    assert_same_calibration(replace(job, objects={"crate": prior(0.02, 0.02)}), device)


@pytest.mark.slow
def test_base_mount_and_joints_of_a_robot(device, carried):
    assert_same_calibration(carried, device)


@pytest.mark.slow
def test_what_was_pushed_and_what_was_added(device, crate):
    meshes = recordings.room()
    real = {
        **meshes,
        "crate": meshes["crate"].copy().apply_translation((0.15, 0.0, 0.0)),
        "new": scenes.box((0.6, 0.6, 0.5), (0.3, 0.5, 2.0), (0.1, 0.2, 0.3)),
    }
    nowhere = torch.zeros(6, dtype=torch.float64)
    job = recordings.hand_held(SMALL, [EYE], error=nowhere, base=prior(1e-4, 1e-4), real=real)
    found = calibrated(job, estimate=False).update
    assert (found.verdicts["crate"].verdict, len(found.added)) == ("moved", 1)
    assert_same_calibration(job, device, estimate=False)


def test_what_is_checked_and_foreseen(device, carried):
    away = moved(carried, device)
    sigmas = [
        [each.expected_sigma for each in checked.parameters]
        for job in (carried, away)
        for checked in (torchcal.check(job), torchcal.foresee(job, generator=generator()))
    ]
    assert_close(sigmas[2:], sigmas[:2], atol=0.0, rtol=1e-3)
    ahead = [torchcal.foresee(job, generator=generator()).next_view for job in (carried, away)]
    assert ahead[0] is not None
    assert ahead[1] is not None
    assert ahead[1].joints == ahead[0].joints


def tracked(job: Job) -> list[Tracked]:
    tracker = Tracker.of(replace(job, frames=()), generator=generator())
    return tracked_camera.followed(tracker, list(job.frames))[1]


def test_a_tracker_of_a_robot(device, carried):
    away = tracked(moved(carried, device))
    for found, expected in zip(away, tracked(carried), strict=True):
        assert found.status == expected.status == TrackStatus.TRACKING
        same(found.T_world_sensor, expected.T_world_sensor, device)
        same(found.covariance, expected.covariance, device)


def test_a_start_anywhere(device):
    astray = twist(2.0, 1.0, -1.0, 1.0, 2.0, -0.5)
    job = replace(recordings.hand_held(LARGE, [EYE], error=astray), initial="anywhere")
    found, expected = (locate(each, generator()) for each in (moved(job, device), job))
    same(found.Ts_world_base[0], expected.Ts_world_base[0], device)


def localised(device: torch.device, call) -> torchcal.Localisation:
    surface = scenes.surface_of(*recordings.room().values())
    site = Site.of(moved(surface, device), scenes.at_rest(surface).to(device), generator())
    covariance = 0.06**2 * torch.eye(6, dtype=torch.float64)
    start = Prior(T_world_sensor=pose(*OFF.tolist()), covariance=covariance)
    image = recordings.record(list(recordings.room().values()), EYE, LARGE)
    mask = torch.ones_like(image, dtype=torch.bool)
    mask[:, :5] = False
    return call(
        image.to(device),
        site,
        LARGE,
        start=moved(start, device),
        mask=mask.to(device),
        generator=generator(),
    )


@pytest.mark.parametrize("call", [torchcal.localise, torchcal.localise_pixels])
def test_one_image_is_localised(device, call):
    found, expected = (localised(each, call) for each in (device, torch.device("cpu")))
    assert found.status == expected.status == Status.CONVERGED
    assert found.pixels is not None
    assert expected.pixels is not None
    same(found.pixels.T_world_sensor, expected.pixels.T_world_sensor, device)
    same(found.pixels.covariance, expected.pixels.covariance, device)
    if expected.elements is not None:
        assert found.elements is not None
        same(found.elements.T_world_sensor, expected.elements.T_world_sensor, device)


def test_elements_and_labels_of_an_image(device):
    image = recordings.record(list(recordings.room().values()), EYE, LARGE)
    found = torchcal.image_features(image.to(device), LARGE)
    expected = torchcal.image_features(image, LARGE)
    # They are found on the CPU, so they are the same ones.
    same(found.planes.elements.point, expected.planes.elements.point, device, 0.0)
    same(found.planes.outline[0], expected.planes.outline[0], device, 0.0)
    same(found.lines.planes, expected.lines.planes, device, 0)
    same(found.vertices.angles, expected.vertices.angles, device, 0.0)
    same(image_labels(image.to(device), LARGE), image_labels(image, LARGE), device, 0)


@pytest.mark.parametrize(
    ("projection", "dtype"), [(scenes.CAMERA, torch.float32), (scenes.LIDAR, torch.float64)]
)
def test_images_and_their_derivatives(device, projection: Projection, dtype: torch.dtype):
    surface = scenes.surface_of(*scenes.cell(), dtype=dtype)
    sensor = scenes.sensor_of(projection, beam=3)
    poses = scenes.at_rest(surface)
    motion = torch.eye(6, dtype=dtype).expand(len(poses), 6, 6)
    expected = torchcal.synthesise(surface, poses, sensor, motion)
    away = poses.to(device).requires_grad_()
    found = torchcal.synthesise(moved(surface, device), away, sensor, motion.to(device))
    found.range.nansum().backward()
    assert away.grad is not None
    assert away.grad.isfinite().all()
    assert found.jacobian is not None
    assert expected.jacobian is not None
    # Machine code adds up in another order.
    same(found.range.detach(), expected.range, device, 1e-4)
    same(found.jacobian.detach(), expected.jacobian, device, 1e-2)


def test_poses_of_elements(device):
    trials = brick.draw_trials(20, "all-pairs", generator=generator())
    expected = find(trials)
    found = torchcal.find_element_poses(
        brick.brick_model().to(device),
        trials.measured.to(device),
        trials.candidates.to(device),
        generator=generator(),
        search=torchcal.ElementSearch(enough=1.0),
    )
    same(found.T_measured_model, expected.T_measured_model, device, 1e-9)
    same(found.covariance, expected.covariance, device, 1e-9)


def test_directions_that_are_looked_at_one_by_one(device, crate, monkeypatch):
    monkeypatch.setattr(reliability, "EXACT", 1.1)  # no curvature is
    job = recordings.hand_held(TINY, [EYE], error=0.1 * OFF)
    both = moved(job, device), job
    found, expected = (reliability.reliability(refined(each)) for each in both)
    same(found.covariance, expected.covariance, device)
