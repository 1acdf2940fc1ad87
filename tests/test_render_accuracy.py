"""The figures of the synthesis on scenes small enough for a test; the script has the large ones."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from jaxtyping import Float
from numpy import ndarray
from scenes import CAMERA, LIDAR, at_rest, box, cell, oracle_of, sensor_of, sheet, surface_of, wall
from scipy.ndimage import maximum_filter
from torch import Tensor

from torchcal.demo import raycast
from torchcal.demo.machine_hall import machine_hall, random_view
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole, Projection, Spherical, pixel_grid
from torchcal.model.read_sensor import preset_sensor
from torchcal.model.scene import Surface, body_poses, build_scene
from torchcal.render.synthesis import synthesise

PROJECTIONS = pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
RMS, MEAN = 1e-3, 1e-4  # m; of the blurred image where a window holds a silhouette
SIDE, BEAM = 512, 21
HALF = math.radians(25.0)
PAPERS = Pinhole(width=SIDE, height=SIDE, fx=549.0, fy=549.0, cx=(SIDE - 1) / 2, cy=(SIDE - 1) / 2)
TURNING = Spherical(width=SIDE, height=SIDE, azimuth=(-HALF, HALF), elevation=(HALF, -HALF))


def window_with_silhouette(ranges: Float[ndarray, "h w"], beam: int) -> ndarray:
    """Pixels in whose window the ranges of rays jump: a plane's inverse range is straight."""
    jumps = np.zeros(ranges.shape, bool)
    for axis in (0, 1):
        bend = np.abs(np.diff(1.0 / ranges, 2, axis=axis))
        margin = [(1, 1) if axis == each else (0, 0) for each in (0, 1)]
        jumps |= np.pad(bend, margin) * ranges > 0.03
    return maximum_filter(jumps, beam)


def plain_ranges(surface: Surface, projection: Projection) -> Tensor:
    """Every ray against every triangle, one after the other (Moeller and Trumbore)."""
    u, v = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    rays = projection.rays(u, v)
    nearest = torch.full(u.shape, torch.inf, dtype=torch.float64)
    for a, b, c in surface.vertices[surface.faces]:
        normal = torch.linalg.cross(rays, (c - a).expand_as(rays))
        determinant = normal @ (b - a)
        first = -(normal @ a) / determinant
        across = torch.linalg.cross(-a, b - a)
        second = (rays @ across) / determinant
        t = (across @ (c - a)) / determinant
        inside = (first >= 0) & (second >= 0) & (first + second <= 1) & (t > 0)
        nearest = torch.where(inside & (t < nearest), t, nearest)
    return nearest


@PROJECTIONS
def test_double_precision_is_that_of_a_plain_loop_over_triangles(projection: Projection):
    surface = surface_of(*cell())
    expected = plain_ranges(surface, projection)
    ranges = synthesise(surface, at_rest(surface), sensor_of(projection, 0)).range
    relative = (ranges / expected - 1.0).abs()
    # A ray through an edge may see either surface.
    assert (relative > 1e-9).double().mean() <= 0.001


@PROJECTIONS
def test_single_precision_is_embrees_off_silhouettes(projection: Projection):
    surface = surface_of(*cell(), dtype=torch.float32)
    ranges = synthesise(surface, at_rest(surface), sensor_of(projection, 0)).range.numpy()
    expected = raycast.predict(oracle_of(*cell()), projection, 0)
    off = ~window_with_silhouette(expected, 3)
    assert off.mean() > 0.4
    assert np.abs(ranges / expected - 1.0)[off].max() < 1e-5


@pytest.mark.slow
@pytest.mark.parametrize("projection", [PAPERS, TURNING], ids=["pinhole", "spherical"])
def test_the_blurred_image_of_the_hall_is_that_of_many_rays(
    projection: Projection, rng: torch.Generator
):
    world = machine_hall()
    scene = build_scene(world, None, dtype=torch.float64, device=torch.device("cpu"))
    T_world_sensor = random_view(rng)
    eye = torch.eye(4, dtype=torch.float64)
    poses = se3.inverse(T_world_sensor) @ body_poses(scene, world, None, eye, None)
    meshes = [
        item.mesh.copy().apply_transform(item.T_world_object.numpy()) for item in world.objects
    ]
    view = raycast.view(meshes, T_world_sensor.numpy())
    window = window_with_silhouette(raycast.predict(view, projection, 0), BEAM)
    ranges = synthesise(scene.surface, poses, sensor_of(projection, BEAM)).range.numpy()
    error = (ranges - raycast.predict(view, projection, BEAM))[window]
    roll = math.degrees(math.asin(float(T_world_sensor[2, 0])))
    assert 5.0 < abs(roll) < 20.0
    assert np.sqrt(np.square(error).mean()) < RMS
    assert abs(error.mean()) < MEAN


@pytest.mark.parametrize(("left", "right"), [(-0.3123, 0.2877), (-0.25, 0.1), (-0.4004, 0.35)])
def test_an_upright_view_has_the_exact_area_worked_out_by_hand(left: float, right: float):
    """A bar across the whole height, before a wall: every pixel's share is a length."""
    side, beam = 96, 21
    camera = Pinhole(width=side, height=side, fx=103.0, fy=103.0, cx=47.5, cy=47.5)
    bar = sheet((left, -9.0, 2.0), (right, -9.0, 2.0), (right, 9.0, 2.0), (left, 9.0, 2.0))
    surface = surface_of(bar, wall(5.0))
    ranges = synthesise(surface, at_rest(surface), sensor_of(camera, beam)).range[40].numpy()
    first, last = (camera.fx * x / 2.0 + camera.cx for x in (left, right))
    start = np.maximum(np.arange(side) - beam / 2, -0.5)
    end = np.minimum(np.arange(side) + beam / 2, side - 0.5)
    near = np.clip(np.minimum(end, last) - np.maximum(start, first), 0.0, None) / (end - start)
    np.testing.assert_allclose(ranges, 2.0 * near + 5.0 * (1.0 - near), atol=1e-9)


def straight_edge(angle: float, offset: float) -> trimesh.Trimesh:
    """Before the optical axis, at 2 m: what lies left of a line through the picture, turned."""
    c, s = math.cos(angle), math.sin(angle)
    corners = [(offset, -90.0), (offset, 90.0), (-90.0, 90.0), (-90.0, -90.0)]
    placed = [(c * a - s * b, s * a + c * b, 2.0) for a, b in corners]
    return sheet(*placed)


@PROJECTIONS
@pytest.mark.parametrize("angle_deg", [8.0, 20.0, 63.0])
def test_half_a_pixel_of_a_straight_edges_motion_changes_the_blurred_image_as_many_rays_say(
    projection: Projection, angle_deg: float
):
    pixel = 2.0 * 0.027  # m at 2 m: one step of either sensor's rays
    change, expected = [], []
    for offset in (-0.5 * pixel, 0.0, 0.5 * pixel):
        bodies = (straight_edge(math.radians(angle_deg), offset + 0.011), wall(5.0))
        surface = surface_of(*bodies)
        change.append(synthesise(surface, at_rest(surface), sensor_of(projection, 9)).range.numpy())
        means = raycast.sampled_means(oracle_of(*bodies), projection)
        expected.append(raycast.box_mean(*means, 9))
    for way in (0, 2):
        error = (change[way] - change[1]) - (expected[way] - expected[1])
        assert np.linalg.norm(error) < 0.02 * np.linalg.norm(expected[way] - expected[1])


@PROJECTIONS
@pytest.mark.parametrize("body", ["sensor", "near", "far"])
def test_the_derivative_is_that_of_central_differences(projection: Projection, body: str):
    """Of the sensor and of each body alone, where no corner passes a row or column of centres."""
    bodies = (straight_edge(math.radians(14.0), 0.0113), wall(5.0))
    surface, sensor = surface_of(*bodies), sensor_of(projection, 9)
    moving = {"sensor": [1.0, 1.0], "near": [1.0, 0.0], "far": [0.0, 1.0]}[body]
    motion = torch.tensor(moving, dtype=torch.float64)[:, None, None] * torch.eye(6).double()
    jacobian = synthesise(surface, at_rest(surface), sensor, motion).jacobian
    assert jacobian is not None
    step, columns = 1e-6, []
    for unit in torch.eye(6, dtype=torch.float64):
        ahead, behind = (
            synthesise(surface, se3.exp(way * step * motion @ unit) @ at_rest(surface), sensor)
            for way in (1.0, -1.0)
        )
        columns.append((ahead.range - behind.range) / (2.0 * step))
    difference = torch.stack(columns, -1)
    assert (jacobian - difference).norm() < 1e-3 * difference.norm()


@pytest.mark.parametrize("body", ["sensor", "machine_b"])
@pytest.mark.parametrize("optics", [Pinhole, Spherical])
def test_the_derivative_in_the_full_hall_is_that_of_central_differences(
    optics: type, body: str, rng: torch.Generator
):
    side, world = 96, machine_hall()
    projection: Projection = Spherical(
        width=side, height=side, azimuth=(-HALF, HALF), elevation=(HALF, -HALF)
    )
    if optics is Pinhole:
        projection = PAPERS.cropped(64, 64, 384, 384).resized(4)
    sensor = sensor_of(projection, 5)
    scene = build_scene(world, None, dtype=torch.float64, device=torch.device("cpu"))
    eye = torch.eye(4, dtype=torch.float64)
    poses = se3.inverse(random_view(rng)) @ body_poses(scene, world, None, eye, None)
    moves = [body in ("sensor", item.name) for item in world.objects]
    motion = torch.zeros(len(poses), 6, 6, dtype=torch.float64)
    motion[torch.tensor(moves)] = torch.eye(6, dtype=torch.float64)
    jacobian = synthesise(scene.surface, poses, sensor, motion).jacobian
    assert jacobian is not None
    step, columns = 1e-6, []
    for unit in torch.eye(6, dtype=torch.float64):
        ahead, behind = (
            synthesise(scene.surface, se3.exp(way * step * motion @ unit) @ poses, sensor).range
            for way in (1.0, -1.0)
        )
        columns.append((ahead - behind) / (2.0 * step))
    difference = torch.stack(columns, -1)
    assert (jacobian - difference).norm() < 1e-3 * difference.norm()


@pytest.mark.filterwarnings("ignore:`torch.jit.script`:DeprecationWarning")  # torch's own
@pytest.mark.parametrize("beam", [1, 3])
@pytest.mark.parametrize("mode", ["reverse", "forward"])
@PROJECTIONS
def test_gradcheck_passes_with_silhouettes_in_view(projection: Projection, beam: int, mode: str):
    """In both directions of automatic differentiation, through two bodies' own poses.

    The part of the picture with a corner of the box: means are right to the fourth order of the
    size of pixels, so these must not be too coarse.
    """
    small = projection.cropped(25, 18, 10, 9)
    bodies = (box((0.8, 0.7, 0.5), (0.1, 0.05, 2.4), (0.3, 0.4, 0.15)), wall(5.0))
    surface, sensor = surface_of(*bodies), sensor_of(small, beam)

    def image(q: Tensor) -> Tensor:
        synthesis = synthesise(surface, se3.exp(q) @ at_rest(surface), sensor)
        assert (synthesis.face.unique() < 12).any()
        return synthesis.range

    q = torch.full((2, 6), 1e-3, dtype=torch.float64, requires_grad=True)
    forward = mode == "forward"
    assert torch.autograd.gradcheck(
        image, q, eps=1e-8, atol=1e-4, rtol=1e-4, check_forward_ad=forward
    )


def test_poses_that_require_gradients_get_them_through_the_blur():
    surface, sensor = surface_of(*cell()), sensor_of(CAMERA, 9)
    poses = at_rest(surface).clone().requires_grad_()
    synthesis = synthesise(surface, poses, sensor)
    synthesis.range.sum().backward()
    assert poses.grad is not None
    assert poses.grad.isfinite().all()
    assert (poses.grad[:, :3].abs().amax((-1, -2)) > 0).all()  # every body is seen


@pytest.mark.parametrize(
    ("name", "near", "first", "side"),
    [("ultrasonic-array", 1.0, 0, 41), ("laser-scanner", 10.0, 150, 64)],
)
def test_the_presets_see_the_area_that_many_rays_see(name: str, near: float, first: int, side: int):
    """Their beam is a pixel's own area; that of 1.5 degrees has sides that are curved."""
    preset = preset_sensor(name)
    projection = preset.projection.cropped(first, first, side, side)
    crate = box((0.05 * near, 0.04 * near, 0.05 * near), (0.0, 0.0, near), (0.2, 0.3, 0.1))
    bodies = (crate, wall(1.2 * near))
    surface = surface_of(*bodies)
    sensor = replace(preset, projection=projection, near=0.0)
    ranges = synthesise(surface, at_rest(surface), sensor).range.numpy()
    expected, _ = raycast.sampled_means(oracle_of(*bodies), projection, raycast.FINE_LATTICE)
    window = window_with_silhouette(raycast.predict(oracle_of(*bodies), projection, 0), 1)
    error = (ranges - expected)[window]
    assert np.sqrt(np.square(error).mean()) < RMS
    assert abs(error.mean()) < MEAN


@PROJECTIONS
def test_a_room_is_seen_from_inside_by_its_back_faces(projection: Projection):
    """Its faces look outwards, and most of it lies beside and behind the sensor."""
    room = box((6.0, 5.0, 8.0), (0.4, 0.3, 0.7), (0.1, 0.2, 0.3))
    surface = surface_of(room)
    for flipped in (surface, replace(surface, faces=surface.faces.flip(1))):
        ranges = synthesise(flipped, at_rest(flipped), sensor_of(projection, 0)).range
        expected = plain_ranges(surface, projection)
        torch.testing.assert_close(ranges, expected, rtol=1e-9, atol=0.0)


def test_triangles_that_pass_behind_the_sensor_are_seen_before_it():
    """A floor of two triangles, 1 m below, reaches 40 m behind the sensor."""
    floor = sheet((-30.0, 1.0, -40.0), (30.0, 1.0, -40.0), (30.0, 1.0, 50.0), (-30.0, 1.0, 50.0))
    surface = surface_of(floor)
    synthesis = synthesise(surface, at_rest(surface), sensor_of(CAMERA, 0))
    _, v = pixel_grid(CAMERA, dtype=torch.float64, device=torch.device("cpu"))
    depth = CAMERA.fy / (v - CAMERA.cy)
    seen = (depth > 0) & (depth < 50.0)
    assert torch.equal(synthesis.range.isfinite(), seen)
    torch.testing.assert_close(synthesis.range[seen], depth[seen], rtol=1e-9, atol=0.0)
