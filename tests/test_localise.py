"""Where one image was taken: what is found, and what is said where it cannot be found."""

import math
from dataclasses import replace

import pytest
import recordings
import scenes
import torch
import trimesh
from recordings import NO_DRIFT, pose, twist
from torch import Tensor

from torchcal.calibrate.localisation import Localisation, StagePose
from torchcal.calibrate.localise import localise, localise_pixels
from torchcal.calibrate.result import Status
from torchcal.calibrate.site import Site
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.match.characteristics import all_elements
from torchcal.match.prior_gate import Prior

CAMERA = Pinhole(width=128, height=128, fx=120.0, fy=121.0, cx=63.2, cy=63.9)
SENSOR = recordings.sensor(CAMERA, sigma=0.01, beam=5)
TRUTH = pose(0.1, -0.1, 0.05, 0.05, -0.1, 0.2)
OFF = twist(0.06, -0.05, 0.06, 0.04, -0.05, 0.05)
"""0.1 m and 5 degrees."""
SIGMA = 0.06
"""m and rad: of the starting value."""
HALL = trimesh.creation.box((4.0, 3.0, 4.0))
"""A quarter turn about y maps it onto itself."""
AT_THE_BACK = pose(0.3, -0.1, -1.6, 0.1, -0.25, 0.2)
"""From here a corner of the hall is in view."""
WALL = scenes.wall(2.0, side=10.0)


def draws() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def site_of(*meshes: trimesh.Trimesh) -> Site:
    surface = scenes.surface_of(*meshes)
    return Site.of(surface, scenes.at_rest(surface), draws())


def start_at(T_world_sensor: Tensor, sigma: float = SIGMA) -> Prior:
    covariance = sigma**2 * torch.eye(6, dtype=torch.float64)
    return Prior(T_world_sensor=T_world_sensor, covariance=covariance)


def image_of(*meshes: trimesh.Trimesh, T_world_sensor: Tensor = TRUTH) -> Tensor:
    return recordings.record(list(meshes), T_world_sensor, SENSOR)


def in_sigmas(found: StagePose, truth: Tensor) -> Tensor:
    xi = se3.log(se3.inverse(truth) @ found.T_world_sensor)
    return (xi @ torch.linalg.solve(found.covariance, xi)).sqrt()


def distance(T: Tensor, other: Tensor) -> float:
    return float(se3.log(se3.inverse(T) @ other).norm())


@pytest.fixture(scope="module")
def room() -> Site:
    return site_of(*recordings.room().values())


@pytest.fixture(scope="module")
def image() -> Tensor:
    return image_of(*recordings.room().values())


@pytest.fixture(scope="module")
def from_start(room: Site, image: Tensor) -> Localisation:
    start = start_at(TRUTH @ se3.exp(OFF))
    return localise(image, room, SENSOR, start=start, generator=draws())


@pytest.fixture(scope="module")
def from_nowhere(room: Site, image: Tensor) -> Localisation:
    return localise(image, room, SENSOR, generator=draws())


@pytest.mark.parametrize("name", ["from_start", "from_nowhere"])
def test_a_furnished_room_is_recognised(name: str, request: pytest.FixtureRequest):
    found: Localisation = request.getfixturevalue(name)
    assert found.status is Status.CONVERGED
    assert found.pixels is not None
    assert float(in_sigmas(found.pixels, TRUTH)) < 5.0  # six degrees of freedom: 1 in 4000
    assert float(found.pixels.covariance.diagonal().sqrt().max()) < 0.003
    assert found.agreement > 0.9
    assert not found.rivals
    assert not found.unobservable
    assert found.elements is not None
    assert distance(found.elements.T_world_sensor, TRUTH) < 0.05


def test_every_element_is_matched_or_alone(from_start: Localisation):
    matches = from_start.matches
    assert matches is not None
    pairs = matches.pairs
    assert 3 <= int(matches.used.sum()) <= len(pairs) <= matches.candidates
    for side, alone, part in (
        (0, matches.model_alone, matches.model),
        (1, matches.measured_alone, matches.measured),
    ):
        listed = torch.cat([pairs[:, side].unique(), alone])
        assert listed.sort().values.tolist() == list(range(all_elements(part).count))


def test_the_same_seed_gives_the_same_pose(room: Site, image: Tensor, from_nowhere: Localisation):
    again = localise(image, room, SENSOR, generator=draws())
    assert again.pixels is not None
    assert from_nowhere.pixels is not None
    assert torch.equal(again.pixels.T_world_sensor, from_nowhere.pixels.T_world_sensor)


def test_pixels_alone_give_the_same_pose(room: Site, image: Tensor, from_start: Localisation):
    start = start_at(TRUTH @ se3.exp(OFF))
    alone = localise_pixels(image, room, SENSOR, start=start, generator=draws())
    assert alone.matches is None
    assert alone.pixels is not None
    assert from_start.pixels is not None
    torch.testing.assert_close(alone.pixels.T_world_sensor, from_start.pixels.T_world_sensor)


def test_a_square_room_is_ambiguous():
    image = image_of(HALL, T_world_sensor=AT_THE_BACK)
    found = localise(image, site_of(HALL), SENSOR, generator=draws())
    assert found.status is Status.AMBIGUOUS
    assert found.pixels is not None
    turn = se3.exp(twist(0.0, 0.0, 0.0, 0.0, math.pi / 2, 0.0))
    poses = [found.pixels.T_world_sensor, *(rival.T_world_sensor for rival in found.rivals)]
    for T in (AT_THE_BACK, turn @ AT_THE_BACK, turn @ turn @ AT_THE_BACK):
        assert min(distance(T, each) for each in poses) < 0.02


def test_the_start_decides_in_a_square_room():
    image = image_of(HALL, T_world_sensor=AT_THE_BACK)
    start = start_at(AT_THE_BACK @ se3.exp(OFF))
    found = localise(image, site_of(HALL), SENSOR, start=start, generator=draws())
    assert found.status is Status.CONVERGED
    assert found.pixels is not None
    assert float(in_sigmas(found.pixels, AT_THE_BACK)) < 5.0


def test_a_single_wall_suggests_no_pose_without_a_start():
    """One direction aligns with the model's in all turns about it: none is tried."""
    found = localise(image_of(WALL), site_of(WALL), SENSOR, generator=draws())
    assert found.status is Status.FAILED
    assert found.pixels is None


def test_a_single_wall_leaves_the_pose_open():
    start = start_at(TRUTH @ se3.exp(OFF))
    found = localise(image_of(WALL), site_of(WALL), SENSOR, start=start, generator=draws())
    assert found.status is Status.UNOBSERVABLE
    words = " ".join(direction.words for direction in found.unobservable)
    assert "a shift of the sensor along x" in words
    assert "a turn of the sensor about z" in words


@pytest.mark.parametrize("anywhere", [False, True])
def test_an_image_of_another_place_is_not_explained(room: Site, anywhere: bool):
    other = scenes.box((3.0, 2.0, 2.2), (0.3, 0.1, 0.2), (0.3, 0.5, 0.2))
    things = scenes.box((0.4, 0.6, 0.3), (0.1, 0.2, 0.7), (0.5, 0.1, 0.3))
    start = None if anywhere else start_at(TRUTH)
    found = localise(image_of(other, things), room, SENSOR, start=start, generator=draws())
    assert found.status is Status.FAILED


def test_a_start_that_is_sure_of_the_wrong_place_does_not_converge(room: Site, image: Tensor):
    wrong = start_at(TRUTH @ se3.exp(10.0 * OFF), sigma=0.01)
    found = localise(image, room, SENSOR, start=wrong, generator=draws())
    assert found.status is Status.FAILED


def test_an_image_without_measurements_has_no_pose(room: Site):
    empty = torch.full((128, 128), torch.nan, dtype=torch.float64)
    for start in (None, start_at(TRUTH)):
        found = localise(empty, room, SENSOR, start=start, generator=draws())
        assert found.status is Status.FAILED
        assert found.pixels is None


def test_a_mask_leaves_out_what_is_not_of_the_model(room: Site):
    stranger = scenes.box((0.5, 1.5, 0.2), (-0.5, 0.0, 1.2))
    image = image_of(*recordings.room().values(), stranger)
    mask = torch.ones(128, 128, dtype=torch.bool)
    mask[:, :60] = False
    start = start_at(TRUTH @ se3.exp(OFF))
    found = localise(image, room, SENSOR, start=start, mask=mask, generator=draws())
    assert found.status is Status.CONVERGED
    assert found.pixels is not None
    assert float(in_sigmas(found.pixels, TRUTH)) < 5.0


def test_noise_that_nobody_knows_is_estimated(room: Site, image: Tensor):
    unknown = replace(SENSOR, noise=replace(SENSOR.noise, drift=None))
    assert SENSOR.noise.drift == NO_DRIFT
    start = start_at(TRUTH @ se3.exp(OFF))
    found = localise_pixels(image, room, unknown, start=start, generator=draws())
    assert found.status is Status.CONVERGED
    assert found.pixels is not None
    assert float(in_sigmas(found.pixels, TRUTH)) < 5.0


def test_a_wall_is_seen_by_its_area_in_the_image():
    site = site_of(WALL)
    (area,) = site.seen_from(
        torch.eye(4, dtype=torch.float64), SENSOR, jump=0.1
    ).plane_area.tolist()
    # At 2 m a pixel of focal lengths 120 and 121 shows (2 / 120) x (2 / 121) m.
    assert area == pytest.approx(128 * 128 * 4.0 / (120.0 * 121.0), rel=0.01)


def test_nothing_is_known_of_a_pose_but_the_site():
    hall = site_of(HALL)
    assert hall.extent.tolist() == pytest.approx([math.sqrt(41.0)] * 3 + [math.pi] * 3)
    torch.testing.assert_close(hall.middle.T_world_sensor, torch.eye(4, dtype=torch.float64))
    torch.testing.assert_close(hall.middle.covariance.diagonal().sqrt(), hall.extent)
