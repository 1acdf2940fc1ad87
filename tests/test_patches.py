"""Objects from patches: joined where they touch, each side once, light, and with provenance."""

import json
import math

import numpy as np
import pytest
import torch
import trimesh

from torchcal.calibrate.patches import MOST_FACES, Patch, merged_objects, simplified
from torchcal.model.world import World, WorldObject, write_world


def sheet(side, centre, pixels=100):
    """A square of triangles across z."""
    grid = trimesh.creation.box(extents=(side, side, 1e-4)).subdivide().subdivide()
    grid.apply_translation(centre)
    grid.metadata["pixels"] = pixels
    return grid


def surface(heights):
    """A square metre of small triangles over the plane z = 0 (m)."""
    side = len(heights)
    x, y = np.meshgrid(np.linspace(0.0, 1.0, side), np.linspace(0.0, 1.0, side))
    index = np.arange(side * side).reshape(side, side)
    a, right, below, across = (
        corner.ravel()
        for corner in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    )
    faces = np.concatenate([np.stack([a, right, below], 1), np.stack([right, across, below], 1)])
    return trimesh.Trimesh(np.stack([x, y, heights], -1).reshape(-1, 3), faces, process=False)


def test_a_flat_side_is_light_and_keeps_its_outline():
    light = simplified(surface(np.zeros((60, 60))))
    assert len(light.faces) < 1000
    assert light.area == pytest.approx(1.0, rel=1e-6)
    np.testing.assert_allclose(light.bounds, [[0.0, 0.0, 0.0], [1.0, 1.0, 0.0]], atol=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_nothing_stands_out_beyond_the_outline_of_a_rough_surface(seed):
    rng = np.random.default_rng(seed)
    fold = 3.0 * np.abs(np.linspace(-0.5, 0.5, 61))[None].repeat(61, 0)
    bent = surface(fold + 0.005 * rng.standard_normal(fold.shape))
    x, y, _ = (bent.triangles_center - [0.5, 0.5, 0.0]).T
    wavy = 0.35 + 0.04 * np.sin(23.0 * np.arctan2(y, x))
    rough = trimesh.Trimesh(bent.vertices, bent.faces[np.hypot(x, y) < wavy], process=False)
    rough.remove_unreferenced_vertices()
    light = simplified(rough)
    assert len(light.faces) < len(rough.faces)
    side = 1.0 / 60.0
    assert (light.bounds[0] > rough.bounds[0] - side).all()
    assert (light.bounds[1] < rough.bounds[1] + side).all()


def test_two_flat_sides_keep_the_edge_between_them():
    fold = np.abs(np.linspace(-0.5, 0.5, 61))[None].repeat(61, 0)
    light = simplified(surface(fold))
    assert len(light.faces) <= MOST_FACES
    assert light.area == pytest.approx(math.sqrt(2.0), rel=1e-3)
    assert light.bounds[0][2] == pytest.approx(0.0, abs=1e-3)


def test_a_rough_side_is_made_light_too():
    rough = surface(np.random.default_rng(0).normal(0.0, 0.001, (60, 60)))
    light = simplified(rough)
    assert 0 < len(light.faces) <= MOST_FACES
    np.testing.assert_allclose(light.bounds[:, :2], rough.bounds[:, :2], atol=0.005)


def test_one_side_seen_twice_is_there_once():
    first, second = (surface(np.full((30, 30), z)) for z in (0.0, 0.004))
    second.apply_translation([0.5, 0.0, 0.0])
    for mesh in (first, second):
        mesh.metadata["pixels"] = 900
    patches = [Patch(frame=f, mesh=m, tolerance=0.01) for f, m in (("a", first), ("b", second))]
    (found,) = merged_objects(patches)
    assert found.mesh.area == pytest.approx(1.5, abs=0.05)


def test_patches_of_two_frames_that_touch_are_one_object():
    near = Patch(frame="a", mesh=sheet(0.3, [0.0, 0.0, 1.0]), tolerance=0.01)
    same = Patch(frame="b", mesh=sheet(0.3, [0.1, 0.0, 1.005]), tolerance=0.01)
    far = Patch(frame="b", mesh=sheet(0.2, [1.0, 0.0, 1.0]), tolerance=0.01)
    one, other = merged_objects([far, near, same])
    assert (one.name, one.frames) == ("added_1", ("a", "b"))
    assert (other.name, other.frames) == ("added_2", ("b",))
    assert one.mesh.metadata == {"source": "range image", "frames": ["a", "b"], "pixels": 200}
    assert one.mesh.extents == pytest.approx([0.4, 0.3, 0.0051])


def test_provenance_stands_in_the_extras_of_the_file(tmp_path):
    (item,) = merged_objects([Patch(frame="a", mesh=sheet(0.3, [0.0, 0.0, 1.0]), tolerance=0.01)])
    eye = torch.eye(4, dtype=torch.float64)
    new = WorldObject(name=item.name, mesh=item.mesh, T_world_object=eye)
    write_world(World(objects=(new,)), tmp_path / "world.glb")
    data = (tmp_path / "world.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    assert tree["meshes"][0]["extras"] == {
        "source": "range image",
        "frames": ["a"],
        "pixels": 100,
    }


def test_things_farther_apart_than_the_tolerances_stay_apart():
    patches = [
        Patch(frame="a", mesh=sheet(0.3, [0.0, 0.0, z]), tolerance=0.01) for z in (1.0, 1.02)
    ]
    assert len(merged_objects(patches)) == 2
    # Two of 1 cm reach farther together, and then they are one.
    nearer = [
        Patch(frame="a", mesh=sheet(0.3, [0.0, 0.0, z]), tolerance=0.01) for z in (1.0, 1.005)
    ]
    assert len(merged_objects(nearer)) == 1


def test_no_patches_are_no_objects():
    assert merged_objects([]) == ()
