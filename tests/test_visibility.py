"""The hard z-buffer against Embree and against a plain loop over rays and triangles."""

import numpy as np
import pytest
import torch
import trimesh
from scenes import CAMERA, LIDAR, ball, box, cell, oracle_of, sheet, surface_of, turned, wall

from torchcal.demo import raycast
from torchcal.geometry.projection import Pinhole, Projection, Spherical, pixel_grid
from torchcal.render.facets import Facets
from torchcal.render.visibility import visible_faces

PROJECTIONS = pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
TIES = 0.002
"""Share of the pixels whose ray passes so near to an edge that single precision decides."""


def hard(bodies: tuple[trimesh.Trimesh, ...], projection: Projection) -> tuple[np.ndarray, ...]:
    """Faces and ranges of one view in double precision."""
    surface = surface_of(*bodies)
    face = visible_faces(surface.vertices[None], surface.faces, projection)[0]
    rays = projection.rays(*pixel_grid(projection, dtype=torch.float64, device=face.device))
    ranges = Facets.of(surface.vertices, surface.faces).ranges(face, rays)
    return face.numpy(), torch.where(face < 0, torch.nan, ranges).numpy()


def assert_as_embree_sees(bodies: tuple[trimesh.Trimesh, ...], projection: Projection) -> None:
    face, ranges = hard(bodies, projection)
    grid = pixel_grid(projection, dtype=torch.float64, device=torch.device("cpu"))
    expected, met = raycast.cast(oracle_of(*bodies), projection.rays(*grid).numpy())
    assert ((face >= 0) != (met >= 0)).mean() <= TIES
    both = (face >= 0) & (met >= 0)
    off = np.abs(ranges[both] - expected[both]) > 1e-6
    assert off.mean() <= TIES if both.any() else met.max() == -1


@PROJECTIONS
def test_a_room_with_boxes_and_a_ball_is_seen_as_embree_sees_it(projection: Projection):
    assert_as_embree_sees(cell(), projection)


@PROJECTIONS
def test_many_small_faces_are_seen_as_embree_sees_them(projection: Projection):
    bumpy = ball(1.0, (0.0, 0.0, 0.0), subdivisions=5)
    bumpy.vertices *= 1.0 + 0.1 * np.sin(9.0 * bumpy.vertices).prod(1, keepdims=True)
    assert len(bumpy.faces) > 20_000
    assert_as_embree_sees((turned(bumpy, (0.1, 0.0, 2.3), (0.1, 0.2, 0.3)),), projection)


@PROJECTIONS
def test_triangles_that_pass_behind_the_sensor_are_seen_in_part(projection: Projection):
    floor = sheet((-9.0, 0.5, -7.0), (9.0, 0.6, -7.0), (9.0, 0.6, 12.0), (-9.0, 0.5, 12.0))
    beside = sheet((0.4, -3.0, -5.0), (0.5, -3.0, 6.0), (0.5, 3.0, 6.0), (0.4, 3.0, -5.0))
    assert_as_embree_sees((floor, beside), projection)


@pytest.mark.parametrize("azimuth", [(-np.pi, np.pi * 0.98), (2.0, 4.5)])
def test_a_spherical_image_sees_behind_itself_and_over_the_seam(azimuth: tuple[float, float]):
    around = Spherical(width=90, height=40, azimuth=azimuth, elevation=(1.5, -1.5))
    assert_as_embree_sees(cell(), around)


@PROJECTIONS
@pytest.mark.parametrize(
    "bodies",
    [(ball(0.5, (0.0, 0.0, -3.0)),), (box((1.0, 1.0, 1.0), (40.0, 0.0, 3.0)),)],
    ids=["behind", "beside"],
)
def test_nothing_is_seen_of_what_is_not_in_view(
    bodies: tuple[trimesh.Trimesh, ...], projection: Projection
):
    assert (hard(bodies, projection)[0] == -1).all()


def nearest_by_loop(corners: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """Ranges by Cramer's rule, one triangle at a time."""
    best = np.full(len(rays), np.inf)
    for a, b, c in corners:
        matrix = np.stack(np.broadcast_arrays(b - a, c - a, -rays), -1)
        with np.errstate(all="ignore"):
            s, t, r = np.linalg.solve(matrix, np.broadcast_to(-a, rays.shape)[..., None])[..., 0].T
        hit = (s >= 0) & (t >= 0) & (s + t <= 1) & (r > 0)
        best = np.where(hit & (r < best), r, best)
    return best


@PROJECTIONS
@pytest.mark.parametrize(("dtype", "relative"), [(torch.float64, 1e-9), (torch.float32, 1e-5)])
def test_ranges_are_those_of_a_plain_loop(
    projection: Projection, dtype: torch.dtype, relative: float
):
    surface = surface_of(*cell()[:3])
    vertices = surface.vertices.to(dtype)
    face = visible_faces(vertices[None], surface.faces, projection)[0]
    rays = projection.rays(*pixel_grid(projection, dtype=dtype, device=face.device))
    ranges = Facets.of(vertices, surface.faces).ranges(face, rays)
    exact = projection.rays(*pixel_grid(projection, dtype=torch.float64, device=face.device))
    corners = surface.vertices[surface.faces].numpy()
    expected = nearest_by_loop(corners, exact.reshape(-1, 3).numpy()).reshape(face.shape)
    error = np.abs(ranges.double().numpy() / expected - 1.0)
    # An edge may pass within rounding of a ray in single precision.
    allowed = 0.0 if dtype == torch.float64 else TIES
    assert (error > relative).mean() <= allowed


@PROJECTIONS
def test_no_ray_slips_through_a_closed_mesh(projection: Projection):
    for dtype in (torch.float32, torch.float64):
        shell = surface_of(ball(2.0, (0.0, 0.0, 0.0), subdivisions=4), dtype=dtype)
        face = visible_faces(shell.vertices[None], shell.faces, projection)[0]
        assert (face >= 0).all()


def test_rays_through_shared_edges_and_corners_meet_a_face():
    exact = Pinhole(width=9, height=9, fx=4.0, fy=4.0, cx=4.0, cy=4.0)
    steps = np.arange(-2.0, 3.0) / 4.0
    grid = np.array([(x, y, 1.0) for y in steps for x in steps])
    quads = [
        (5 * j + i, 5 * j + i + 1, 5 * j + i + 6, 5 * j + i + 5) for j in range(4) for i in range(4)
    ]
    faces = [t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))]
    surface = surface_of(trimesh.Trimesh(vertices=grid, faces=faces, process=False))
    face = visible_faces(surface.vertices[None], surface.faces, exact)[0]
    assert (face[2:7, 2:7] >= 0).all()
    assert (face[:2] == -1).all()


@PROJECTIONS
def test_a_degenerate_or_nan_face_leaves_the_others_untouched(projection: Projection):
    surface = surface_of(*cell())
    alone = visible_faces(surface.vertices[None], surface.faces, projection)
    line = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.1, 1.0], [0.2, 0.2, 1.0]])
    nan = torch.tensor([[torch.nan, 0.0, 1.0], [0.1, 0.0, 1.0], [0.0, torch.inf, 1.0]])
    vertices = torch.cat([surface.vertices, line, nan])
    extra = len(surface.vertices) + torch.arange(6).view(2, 3)
    together = visible_faces(vertices[None], torch.cat([surface.faces, extra]), projection)
    assert torch.equal(together, alone)


def test_views_of_a_batch_are_seen_as_if_each_were_alone():
    surface = surface_of(*cell())
    views = torch.stack([surface.vertices, surface.vertices + 0.1, surface.vertices - 0.2])
    together = visible_faces(views, surface.faces, CAMERA)
    for view, face in zip(views, together, strict=True):
        assert torch.equal(visible_faces(view[None], surface.faces, CAMERA)[0], face)


def test_the_nearer_of_two_walls_is_seen_whatever_their_order():
    for first, second, seen in ((1.0, 2.0, {0, 1}), (2.0, 1.0, {2, 3})):
        face, _ = hard((wall(first), wall(second)), CAMERA)
        assert set(face.ravel().tolist()) == seen
