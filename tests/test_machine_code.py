"""Rendering in machine code against that by tensors, and the batch against single views."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch
from scenes import CAMERA, LIDAR, at_rest, ball, box, cell, sensor_of, sheet, surface_of, turned

from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole, Projection, Spherical
from torchcal.model.scene import Surface
from torchcal.render import machine_code, visibility, zbuffer
from torchcal.render.synthesis import synthesise

if find_spec("numba") is None:
    pytest.skip("numba is not installed", allow_module_level=True)

from torchcal.render.machine_code import zbuffer as raster

AROUND = Spherical(width=90, height=40, azimuth=(-3.1, 3.1), elevation=(1.5, -1.5))
WIDE = Pinhole(width=150, height=131, fx=60.0, fy=62.0, cx=70.3, cy=66.2)
PROJECTIONS = pytest.mark.parametrize("projection", [CAMERA, LIDAR, AROUND, WIDE])
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])


def bumpy(subdivisions: int = 5) -> Surface:
    mesh = ball(1.0, (0.0, 0.0, 0.0), subdivisions)
    mesh.vertices *= 1.0 + 0.1 * np.sin(9.0 * mesh.vertices).prod(1, keepdims=True)
    return surface_of(turned(mesh, (0.1, 0.0, 2.3), (0.1, 0.2, 0.3)))


def behind() -> Surface:
    """Passes behind the sensor; the second sheet lies in the first and ties with it."""
    floor = sheet((-9.0, 0.5, -7.0), (9.0, 0.6, -7.0), (9.0, 0.6, 12.0), (-9.0, 0.5, 12.0))
    return surface_of(floor, floor.copy(), box((0.2, 0.2, 0.2), (0.0, 0.1, 2.0)))


SURFACES = pytest.mark.parametrize("make", [lambda: surface_of(*cell()), bumpy, behind])


@PROJECTIONS
@DTYPES
@SURFACES
def test_machine_code_sees_the_faces_that_tensors_see(make, projection: Projection, dtype):
    surface = make()
    vertices = torch.stack([surface.vertices, surface.vertices + 0.03]).to(dtype)
    seen = raster.visible_faces(vertices, surface.faces, projection)
    expected = zbuffer.visible_faces(vertices, surface.faces, projection)
    assert (expected >= 0).any()
    # The cones that cull are made otherwise; and rounding may decide at an edge.
    assert (seen != expected).double().mean() < 1e-4


def test_of_faces_in_the_same_place_the_first_is_seen():
    surface = behind()
    for module in (raster, zbuffer):
        face = module.visible_faces(surface.vertices[None], surface.faces, CAMERA)
        assert not torch.isin(face, torch.tensor([2, 3])).any()
        assert torch.isin(face, torch.tensor([0, 1])).any()


def test_one_thread_sees_what_two_see():
    vertices, faces = (surface := bumpy()).vertices[None], surface.faces
    threads = torch.get_num_threads()
    try:
        views = []
        for count in (1, 2):
            torch.set_num_threads(count)
            views.append(raster.visible_faces(vertices, faces, WIDE))
    finally:
        torch.set_num_threads(threads)
    assert torch.equal(*views)


def pile(seed: int) -> Surface:
    """Boxes and a ball that pass through one another: seams, some of them within a pixel."""
    rng = np.random.default_rng(seed)
    boxes = [
        box(
            tuple(rng.uniform(0.1, 0.9, 3)),
            tuple(rng.uniform((-0.9, -0.7, 1.6), (0.9, 0.7, 3.4))),
            tuple(rng.uniform(0.0, 3.0, 3)),
        )
        for _ in range(12)
    ]
    return surface_of(*boxes, ball(0.5, (0.1, 0.2, 2.5)))


@pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
@pytest.mark.parametrize("beam", [1, 5])
@pytest.mark.parametrize(
    "make",
    [lambda: surface_of(*cell()), lambda: bumpy(3), behind, lambda: pile(0), lambda: pile(2)],
    ids=["cell", "bumpy", "behind", "pile", "another pile"],
)
def test_without_numba_the_images_are_the_same(
    make, projection: Projection, beam: int, monkeypatch: pytest.MonkeyPatch, rng: torch.Generator
):
    """Ranges, coverage, jumps and derivatives of two views in which bodies move in their ways."""
    surface, sensor = make(), sensor_of(projection, beam, near=0.5, far=4.0)
    bodies = int(surface.vertex_body.max()) + 1
    motion = torch.randn(2, bodies, 6, 3, generator=rng, dtype=torch.float64)
    turns = 0.02 * torch.randn(2, 1, 6, generator=rng, dtype=torch.float64)
    poses = se3.exp(turns) @ at_rest(surface)
    assert visibility.machine_code_for(surface.vertices, "zbuffer") is raster
    with_numba = synthesise(surface, poses, sensor, motion)
    monkeypatch.setattr(machine_code, "_loaded", lambda _: None)
    by_tensors = synthesise(surface, poses, sensor, motion)
    assert with_numba.jacobian is not None
    assert by_tensors.jacobian is not None
    # The same in double precision, in another order: slivers of 1e-6 pixels may show either face.
    torch.testing.assert_close(
        with_numba.range, by_tensors.range, rtol=1e-6, atol=0, equal_nan=True
    )
    torch.testing.assert_close(with_numba.coverage, by_tensors.coverage, rtol=0, atol=1e-9)
    torch.testing.assert_close(with_numba.jacobian, by_tensors.jacobian, rtol=1e-5, atol=1e-5)
    assert torch.equal(with_numba.jump, by_tensors.jump)
    assert torch.equal(with_numba.face, by_tensors.face)


def test_a_module_that_cannot_be_loaded_is_none():
    assert machine_code.machine_code_for(torch.zeros(1), "no_such_module") is None


@pytest.mark.parametrize("projection", [CAMERA, LIDAR], ids=["pinhole", "spherical"])
def test_images_do_not_depend_on_the_chunk(projection: Projection, rng: torch.Generator):
    surface, sensor = surface_of(*cell()), sensor_of(projection, 3)
    twists = 0.05 * torch.randn(7, 6, generator=rng, dtype=torch.float64)
    poses = se3.exp(twists)[:, None] @ at_rest(surface)
    motion = torch.randn(7, 4, 6, 5, generator=rng, dtype=torch.float64)
    whole = synthesise(surface, poses, sensor, motion, chunk=7)
    for chunk in (1, 3):
        parts = synthesise(surface, poses, sensor, motion, chunk=chunk)
        torch.testing.assert_close(parts.range, whole.range, equal_nan=True, rtol=0, atol=0)
        assert torch.equal(parts.face, whole.face)
        assert parts.jacobian is not None
        assert whole.jacobian is not None
        assert torch.equal(parts.jacobian, whole.jacobian)


def test_bodies_without_triangles_move_too(rng: torch.Generator):
    """Poses of more bodies than the surface has: views must not take each other's motion."""
    surface, sensor = surface_of(*cell()), sensor_of(CAMERA, 1)
    poses = torch.eye(4, dtype=torch.float64).repeat(2, 6, 1, 1)
    motion = torch.randn(2, 6, 6, 3, generator=rng, dtype=torch.float64)
    together = synthesise(surface, poses, sensor, motion, chunk=2).jacobian
    assert together is not None
    for view in (0, 1):
        alone = synthesise(surface, poses[view], sensor, motion[view]).jacobian
        assert alone is not None
        assert torch.equal(alone, together[view])


@pytest.mark.parametrize("count", [0, 2])
def test_a_batch_may_be_empty_and_its_images_keep_their_shape(count: int):
    surface, sensor = surface_of(*cell()), sensor_of(CAMERA, 3)
    poses = at_rest(surface).expand(count, 3, -1, 4, 4)
    motion = torch.zeros(count, 3, poses.shape[2], 6, 2, dtype=torch.float64)
    synthesis = synthesise(surface, poses, sensor, motion)
    assert synthesis.range.shape == (count, 3, 32, 40)
    assert synthesis.jacobian is not None
    assert synthesis.jacobian.shape == (count, 3, 32, 40, 2)
