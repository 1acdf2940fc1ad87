"""The demo's ray caster against closed forms: it is the oracle of other tests."""

import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh

from torchcal.demo import raycast
from torchcal.errors import TorchcalError
from torchcal.geometry.projection import Pinhole, Spherical
from torchcal.model.sensor import Noise, Sensor

CAMERA = Pinhole(width=24, height=20, fx=30.0, fy=28.0, cx=11.2, cy=9.7)
LIDAR = Spherical(width=24, height=20, azimuth=(-0.4, 0.4), elevation=(0.3, -0.3))
AT_ORIGIN = np.eye(4)
DOUBLE = 1e-9  # m; the plane is intersected in double precision
ONE_SAMPLE = 1.0 / raycast.LATTICE.samples  # the lattice has one sample for each row and column


def sheet(corners: list[tuple[float, float, float]]) -> trimesh.Trimesh:
    """A square from its four corners."""
    return trimesh.Trimesh(vertices=corners, faces=[[0, 1, 2], [0, 2, 3]], process=False)


def wall(
    z: Callable[[float, float], float],
    x: tuple[float, float] = (-50.0, 50.0),
    y: tuple[float, float] = (-50.0, 50.0),
) -> trimesh.Trimesh:
    corners = [(a, b) for a, b in ((x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1]))]
    return sheet([(a, b, z(a, b)) for a, b in corners])


def slanted(x: float, y: float) -> float:
    return 3.0 + 0.05 * x - 0.04 * y


def slanted_depth(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """z = 3 + 0.05 x - 0.04 y along the ray (x/z, y/z, 1)."""
    return 3.0 / (1.0 - 0.05 * (u - CAMERA.cx) / CAMERA.fx + 0.04 * (v - CAMERA.cy) / CAMERA.fy)


def centres() -> tuple[np.ndarray, np.ndarray]:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width].astype(float)
    return u, v


def test_an_ideal_ray_meets_a_slanted_plane_where_the_closed_form_says():
    depth = raycast.predict(raycast.view([wall(slanted)], AT_ORIGIN), CAMERA, beam=0)
    np.testing.assert_allclose(depth, slanted_depth(*centres()), atol=DOUBLE)


def test_a_pixel_of_a_slanted_plane_is_the_mean_over_its_area():
    nodes, weights = np.polynomial.legendre.leggauss(12)
    u, v = centres()
    expected = sum(
        wu * wv / 4 * slanted_depth(u + du / 2, v + dv / 2)
        for du, wu in zip(nodes, weights, strict=True)
        for dv, wv in zip(nodes, weights, strict=True)
    )
    mean, share = raycast.pixel_means(raycast.view([wall(slanted)], AT_ORIGIN), CAMERA)
    np.testing.assert_allclose(mean, expected, atol=DOUBLE)
    np.testing.assert_array_equal(share, 1.0)


def test_sampling_every_pixel_finds_the_same_means():
    """But for what rounding does to the planes' pixels, and the lattice's error at the bar."""
    bar = wall(lambda x, y: 2.0, x=(0.01, 0.013))  # thinner than a pixel: beside its corners
    near = wall(lambda x, y: 1.5, x=(-0.4, -0.1), y=(-0.2, 0.1))
    scene = raycast.view([wall(slanted), bar, near], AT_ORIGIN)
    mean, share = raycast.pixel_means(scene, CAMERA)
    sampled, everywhere = raycast.sampled_means(scene, CAMERA)
    np.testing.assert_array_equal(share, everywhere)
    bar_column = round(0.0115 / 2.0 * CAMERA.fx + CAMERA.cx)
    kept = np.arange(CAMERA.width) != bar_column
    np.testing.assert_allclose(mean[:, kept], sampled[:, kept], atol=1e-6)
    width = 0.003 / 2.0 * CAMERA.fx
    np.testing.assert_allclose(
        slanted_depth(*centres())[:, bar_column] - sampled[:, bar_column],
        width * (slanted_depth(*centres())[:, bar_column] - 2.0),
        atol=2.0 * ONE_SAMPLE,
    )


def test_the_pose_of_the_sensor_moves_the_rays():
    T_world_sensor = trimesh.transformations.euler_matrix(0.3, -0.2, 0.5)
    T_world_sensor = np.asarray(T_world_sensor, np.float64)
    T_world_sensor[:3, 3] = (1.0, -2.0, 0.5)
    moved = wall(slanted).apply_transform(T_world_sensor)
    depth = raycast.predict(raycast.view([moved], T_world_sensor), CAMERA, beam=0)
    np.testing.assert_allclose(depth, slanted_depth(*centres()), atol=DOUBLE)


def test_a_spherical_sensor_measures_the_distance_to_a_sphere():
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=2.0)
    distance = raycast.predict(raycast.view([sphere], AT_ORIGIN), LIDAR, beam=0)
    sagitta = 2.0 - np.linalg.norm(sphere.triangles_center, axis=1).min()
    assert sagitta < 2e-3
    assert distance.max() <= 2.0 + DOUBLE
    assert distance.min() >= 2.0 - sagitta - DOUBLE


@pytest.mark.parametrize("column", [7.5, 7.75, 8.0, 8.31, 8.5])
def test_a_pixel_across_an_upright_silhouette_is_weighted_by_area(column: float):
    edge = (column - CAMERA.cx) / CAMERA.fx  # x of the edge at depth 1
    near = wall(lambda x, y: 1.0, x=(-10.0, edge))
    far = wall(lambda x, y: 4.0)
    mean, share = raycast.pixel_means(raycast.view([near, far], AT_ORIGIN), CAMERA)
    covered = np.clip(column + 0.5 - np.arange(CAMERA.width), 0.0, 1.0)
    expected = np.broadcast_to(covered * 1.0 + (1.0 - covered) * 4.0, mean.shape)
    np.testing.assert_allclose(mean, expected, atol=3.0 * ONE_SAMPLE)
    np.testing.assert_array_equal(share, 1.0)


def test_nothing_returns_from_beyond_the_limits():
    """An upright silhouette: what is too near or too far is left out of the mean."""
    meshes = [wall(lambda x, y: 1.0, x=(-10.0, 0.0)), wall(lambda x, y: 4.0)]
    covered = np.clip(CAMERA.cx + 0.5 - np.arange(CAMERA.width), 0.0, 1.0)
    for near, far, depth, expected in ((0.5, 3.0, 1.0, covered), (2.0, 9.0, 4.0, 1.0 - covered)):
        scene = raycast.view(meshes, AT_ORIGIN, near=near, far=far)
        mean, share = raycast.pixel_means(scene, CAMERA)
        np.testing.assert_allclose(share, np.broadcast_to(expected, share.shape), atol=ONE_SAMPLE)
        np.testing.assert_allclose(mean[share > 0], depth, atol=DOUBLE)


def test_a_turned_silhouette_covers_the_area_that_it_encloses():
    angle = np.radians(20.0)  # along none of the lattice's own lines
    corners = np.array([(-0.2, -0.15), (0.2, -0.15), (0.2, 0.15), (-0.2, 0.15)])
    turned = corners @ np.array([(np.cos(angle), np.sin(angle)), (-np.sin(angle), np.cos(angle))])
    square = sheet([(x, y, 1.0) for x, y in turned])
    mean, share = raycast.pixel_means(raycast.view([square], AT_ORIGIN), CAMERA)
    area = 0.4 * 0.3 * CAMERA.fx * CAMERA.fy
    edge_pixels = np.count_nonzero((share > 0) & (share < 1))
    assert abs(share.sum() - area) < edge_pixels**0.5 * ONE_SAMPLE
    np.testing.assert_allclose(mean[share > 0], 1.0, atol=DOUBLE)


def test_no_ray_slips_through_the_edges_of_a_closed_box():
    box = trimesh.creation.box((2.0, 2.0, 2.0)).subdivide().subdivide()
    at_vertices = box.vertices
    edges = box.vertices[box.edges_unique]
    share = np.linspace(0.0, 1.0, 97)[:, None, None]
    on_edges = ((1.0 - share) * edges[:, 0] + share * edges[:, 1]).reshape(-1, 3)
    rays = np.concatenate([at_vertices, on_edges])
    ranges, face = raycast.cast(raycast.view([box], AT_ORIGIN), rays)
    assert (face >= 0).all()
    np.testing.assert_allclose(ranges, 1.0, atol=1e-6)  # single precision chooses the face


@pytest.mark.parametrize("beam", [1, 3, 5, 4])
def test_the_box_mean_is_clipped_at_the_border(beam: int):
    generator = np.random.default_rng(0)
    mean = generator.uniform(1.0, 5.0, (9, 7))
    share = generator.choice([0.0, 0.3, 1.0], (9, 7))
    share[:6, :6] = 0.0
    expected = np.full(mean.shape, np.nan)
    for row, column in np.ndindex(*mean.shape):
        total = area = 0.0
        for r, c in np.ndindex(*mean.shape):
            overlap = [
                max(0.0, min(a + 0.5, b + beam / 2) - max(a - 0.5, b - beam / 2))
                for a, b in ((r, row), (c, column))
            ]
            total += overlap[0] * overlap[1] * share[r, c] * mean[r, c]
            area += overlap[0] * overlap[1] * share[r, c]
        expected[row, column] = total / area if area > 0 else np.nan
    assert np.isnan(expected).any()
    np.testing.assert_allclose(raycast.box_mean(mean, share, beam), expected, atol=1e-12)


def test_nothing_is_measured_where_nothing_stands():
    behind = wall(lambda x, y: -1.0)
    view = raycast.view([behind], AT_ORIGIN)
    for beam in (0, 1, 5):
        assert np.isnan(raycast.predict(view, CAMERA, beam)).all()


def test_noise_follows_the_seed_and_the_limits_cut():
    sensor = Sensor(projection=CAMERA, noise=Noise(a=0.02, b=0.01), near=1.0, far=4.0, beam=1)
    flat = np.full((400, 400), 3.0)
    first, again = (raycast.measure(flat, sensor, np.random.default_rng(5)) for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert abs(first.std() / 0.05 - 1.0) < 4.0 / np.sqrt(2 * flat.size)  # four sigma
    assert abs(first.mean() - 3.0) < 4.0 * 0.05 / np.sqrt(flat.size)
    for outside in (0.5, 5.0, np.nan):
        assert np.isnan(
            raycast.measure(np.full((3, 3), outside), sensor, np.random.default_rng(0))
        ).all()


def test_rays_come_from_the_projection_in_double_precision():
    rays = CAMERA.rays(
        torch.tensor([3.0], dtype=torch.float64), torch.tensor([4.0], dtype=torch.float64)
    )
    ranges, face = raycast.cast(raycast.view([wall(slanted)], AT_ORIGIN), rays.numpy())
    assert ranges.dtype == np.float64
    assert face.shape == (1,)


def test_a_missing_embree_is_named(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "embreex.rtcore_scene", None)
    with pytest.raises(TorchcalError, match="embreex"):
        raycast.view([wall(slanted)], AT_ORIGIN)
