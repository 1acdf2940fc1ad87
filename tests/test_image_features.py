"""Elements of range images of known scenes, made by the ray caster."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from torchcal.demo import raycast
from torchcal.geometry.projection import Pinhole, Spherical
from torchcal.match.features import LineKind
from torchcal.match.image.blocks import in_blocks
from torchcal.match.image.features import image_features, image_labels
from torchcal.match.image.strips import beam_share
from torchcal.match.image.windows import prepared
from torchcal.model.sensor import Noise, Sensor

FOCAL = 128 / math.tan(math.radians(25.0))
SENSOR = Sensor(
    projection=Pinhole(width=256, height=256, fx=FOCAL, fy=FOCAL, cx=127.5, cy=127.5),
    noise=Noise(a=0.02),
    near=0.3,
    far=20.0,
    beam=11,
)
WALL = trimesh.creation.box((10.0, 10.0, 0.2)).apply_translation((0.0, 0.0, 4.1))
SIDE = trimesh.creation.box((0.2, 10.0, 10.0)).apply_translation((0.9, 0.0, 4.0))
PANEL = trimesh.creation.box((1.2, 1.0, 0.1)).apply_translation((0.0, 0.0, 3.0))
SURE = 4.5  # standard deviations: one in a hundred thousand tries is farther off


def _image(meshes: list[trimesh.Trimesh], sensor: Sensor = SENSOR) -> torch.Tensor:
    scene = raycast.view(meshes, np.eye(4))
    ranges = raycast.predict(scene, sensor.projection, sensor.beam)
    return torch.from_numpy(raycast.measure(ranges, sensor, np.random.default_rng(1)))


def test_a_wall_is_one_plane_without_lines() -> None:
    features = image_features(_image([WALL]), SENSOR)
    planes = features.planes.elements
    assert planes.count == 1
    assert features.lines.elements.count == 0
    off = planes.point[0, 2] - 4.0
    assert abs(off) < SURE * planes.covariance[0, 2, 2].sqrt()
    torch.testing.assert_close(
        planes.direction[0], torch.tensor([0.0, 0.0, -1.0]).double(), atol=2e-3, rtol=0.0
    )


def test_area_and_outline_are_those_of_what_is_seen() -> None:
    planes = image_features(_image([WALL]), SENSOR).planes
    side = 256 / FOCAL * 4.0
    torch.testing.assert_close(planes.area[0].item(), side**2, rtol=0.03, atol=0.0)
    torch.testing.assert_close(
        planes.outline[0].abs().amax(0)[:2],
        torch.full((2,), side / 2).double(),
        atol=0.1,
        rtol=0.0,
    )


def test_planes_that_meet_have_a_concave_crease() -> None:
    lines = image_features(_image([WALL, SIDE]), SENSOR).lines
    assert lines.kind.tolist() == [LineKind.CONCAVE]
    assert abs(lines.dihedral[0] - math.pi / 2) < SURE * lines.dihedral_sigma[0]
    point, covariance = lines.elements.point[0], lines.elements.covariance[0]
    assert abs(point[0] - 0.8) < SURE * covariance[0, 0].sqrt()
    assert abs(point[2] - 4.0) < SURE * covariance[2, 2].sqrt()
    assert abs(lines.elements.direction[0, 1]) > math.cos(math.radians(1.0))


def test_crease_is_convex_where_it_points_to_the_sensor() -> None:
    turn = trimesh.transformations.rotation_matrix(math.radians(45.0), (0, 1, 0))
    box = trimesh.creation.box((4.0, 10.0, 4.0)).apply_transform(turn)
    lines = image_features(_image([box.apply_translation((0.0, 0.0, 6.0))]), SENSOR).lines
    assert lines.kind.tolist() == [LineKind.CONVEX]


def test_panel_before_a_wall_has_four_jump_edges_on_itself() -> None:
    lines = image_features(_image([WALL, PANEL]), SENSOR).lines
    assert lines.kind.tolist() == [LineKind.JUMP] * 4
    deviation = lines.elements.covariance[:, 2, 2].sqrt()
    assert ((lines.elements.point[:, 2] - 2.95).abs() < SURE * deviation).all()
    upright = lines.elements.direction[:, 1].abs() > 0.9
    assert upright.sum() == 2
    half = torch.where(
        upright, lines.elements.point[:, 0].abs() - 0.6, lines.elements.point[:, 1].abs() - 0.5
    )
    assert (half.abs() < 0.01).all()  # m: a pixel is 1.1 cm wide there


def test_line_names_the_planes_beside_it_nearer_first() -> None:
    features = image_features(_image([WALL, PANEL]), SENSOR)
    depth = features.planes.elements.point[features.lines.planes, 2]
    torch.testing.assert_close(depth[:, 0], torch.full((4,), 2.95).double(), atol=0.02, rtol=0.0)
    torch.testing.assert_close(depth[:, 1], torch.full((4,), 4.0).double(), atol=0.02, rtol=0.0)


def test_ends_at_the_border_of_the_image_are_no_ends() -> None:
    crease = image_features(_image([WALL, SIDE]), SENSOR).lines
    panel = image_features(_image([WALL, PANEL]), SENSOR).lines
    assert not crease.is_end.any()
    assert panel.is_end.all()


def test_errors_of_planes_are_those_their_covariance_says() -> None:
    scene = raycast.view([WALL], np.eye(4))
    clean = raycast.predict(scene, SENSOR.projection, SENSOR.beam)
    rng = np.random.default_rng(3)
    scores = []
    for _ in range(20):
        noisy = torch.from_numpy(raycast.measure(clean, SENSOR, rng))
        plane = image_features(noisy, SENSOR).planes.elements
        scores.append((plane.point[0, 2] - 4.0).square() / plane.covariance[0, 2, 2])
    # The mean of 20 squares is between 0.37 and 2 in 99.8 of 100 tries.
    assert 0.2 < float(torch.stack(scores).mean()) < 2.0


def test_spherical_sensor_sees_the_same_wall() -> None:
    angle = math.radians(25.0)
    optics = Spherical(width=128, height=128, azimuth=(-angle, angle), elevation=(angle, -angle))
    sensor = replace(SENSOR, projection=optics, beam=5)
    planes = image_features(_image([WALL], sensor), sensor).planes.elements
    assert planes.count == 1
    assert abs(planes.point[0, 2] - 4.0) < SURE * planes.covariance[0, 2, 2].sqrt()


@pytest.mark.parametrize("value", [0.0, math.nan])
def test_image_without_measurements_has_no_elements(value: float) -> None:
    image = torch.full((256, 256), value, dtype=torch.float64)
    features = image_features(image, SENSOR)
    assert features.planes.elements.count == 0
    assert features.lines.elements.count == 0
    assert features.vertices.elements.count == 0


def test_pixels_outside_the_mask_are_not_used() -> None:
    image = _image([WALL, PANEL])
    mask = image_labels(_image([WALL]), SENSOR) >= 0
    mask[:, 60:200] = False
    planes = image_features(image, SENSOR, mask).planes.elements
    assert (planes.point[:, 2] > 3.9).all()
    assert planes.count > 0


@pytest.mark.parametrize("turn", [0.0, 0.3, math.pi / 4])
def test_share_of_a_beam_beyond_a_line_is_that_of_samples(turn: float) -> None:
    normal = np.array([math.cos(turn), math.sin(turn)])
    place = (np.arange(400) + 0.5) / 400 * 21 - 10.5
    offset = (place[:, None] * normal[0] + place * normal[1]).ravel()
    for across in (-12.0, -6.0, 0.0, 3.0, 9.0):
        share, _, moment = beam_share(np.array([across]), 21 * np.abs(normal))
        beyond = offset + across > 0
        assert abs(share[0] - beyond.mean()) < 2e-3  # 400 samples along each side
        assert abs(moment[0] - (offset * beyond).mean()) < 2e-2


@pytest.mark.slow
def test_errors_of_jump_edges_are_those_their_covariance_says() -> None:
    scene = raycast.view([WALL, PANEL], np.eye(4))
    clean = raycast.predict(scene, SENSOR.projection, SENSOR.beam)
    rng = np.random.default_rng(0)
    scores = []
    for _ in range(10):
        noisy = torch.from_numpy(raycast.measure(clean, SENSOR, rng))
        lines = image_features(noisy, SENSOR).lines.elements
        for point, turn, covariance in zip(
            lines.point, lines.direction, lines.covariance, strict=True
        ):
            across, half = (0, 0.6) if turn[1].abs() > 0.9 else (1, 0.5)
            error = torch.stack(
                [point[across].abs() - half, point[2] - 2.95, turn[across], turn[2]]
            )
            scores.append(error.square() / covariance.diagonal()[[across, 2, 3 + across, 5]])
    assert len(scores) == 40
    # Means of 40 squares of deviations: between 0.55 and 1.7 in 99.8 of 100 tries.
    mean = torch.stack(scores).mean(0)
    assert (mean > 0.5).all()
    assert (mean < 1.8).all()


def test_pixel_that_two_planes_explain_shows_the_larger_one() -> None:
    sharp = replace(SENSOR, noise=Noise(a=0.002), beam=1)
    side = trimesh.creation.box((0.2, 10.0, 10.0)).apply_translation((1.5, 0.0, 4.0))
    label = image_labels(_image([WALL, side], sharp), sharp).numpy()
    # The wall ends and the side begins at x = 1.4, z = 4: column 127.5 + 1.4 / 4 * FOCAL.
    corner = int(127.5 + 1.4 / 4.0 * FOCAL)
    wall, beside = label[128, 20], label[128, 252]
    assert wall != beside
    assert (label[20:236, 20 : corner - 1] == wall).mean() > 0.999
    assert (label[20:236, corner + 6 :] == beside).mean() > 0.99


def test_blocks_are_means_of_the_pixels_that_the_beam_blurs_together() -> None:
    sensor = replace(SENSOR, beam=21)
    image = prepared(_image([WALL], sensor), sensor, None)
    blocks = in_blocks(image)
    assert blocks.side == 2
    torch.testing.assert_close(
        torch.tensor(blocks.range[3, 5]), image.range[6:8, 10:12].mean(), atol=1e-12, rtol=0.0
    )
    assert abs(blocks.sigma[3, 5] - 0.02 / 2) < 1e-12
