"""Reading the world: objects, poses and colours as the file has them."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from trimesh.exchange.gltf import export_gltf
from world_files import coloured_box, identity, load, pose_of, saved, world_vertices

from torchcal.errors import JobError
from torchcal.model.meshes import face_colours

EMPTY_BIN = Path(__file__).parents[2] / "shared" / "jobs" / "arc_bin" / "empty_bin.glb"


def test_nodes_are_objects_with_their_poses_and_no_axis_is_turned(tmp_path: Path):
    pose = pose_of(1, 2, 3, 0.3, -0.2, 0.5)
    scene = trimesh.Scene()
    scene.add_geometry(coloured_box((200, 30, 10)), node_name="crate", transform=pose.numpy())
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), node_name="table")
    world = load(saved(scene, tmp_path))
    assert [item.name for item in world.objects] == ["crate", "table"]  # sorted
    torch.testing.assert_close(world.objects[0].T_world_object, pose, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(world.objects[0].mesh.bounds, [(-0.5, -1, -1.5), (0.5, 1, 1.5)])
    torch.testing.assert_close(world.objects[1].T_world_object, identity())


def test_one_geometry_at_two_nodes_is_two_objects(tmp_path: Path):
    scene = trimesh.Scene({"part": trimesh.creation.box((1, 1, 1))})
    scene.graph.update("other", geometry="part", matrix=pose_of(5, 0, 0, 0, 0, 0).numpy())
    world = load(saved(scene, tmp_path))
    assert {item.name for item in world.objects} == {"part", "other"}
    assert world.objects[0].mesh is not world.objects[1].mesh


def test_scale_shear_and_mirror_go_into_the_mesh(tmp_path: Path):
    pose = pose_of(1, 2, 3, 0.3, -0.2, 0.5).numpy()
    stretch = np.array([[2, 0.3, 0, 0], [0.3, 1, 0, 0], [0, 0, -0.5, 0], [0, 0, 0, 1.0]])
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1, 1, 1)), node_name="a", transform=pose @ stretch)
    world = load(saved(scene, tmp_path))
    R = world.objects[0].T_world_object[:3, :3]
    torch.testing.assert_close(R @ R.mT, torch.eye(3).double())
    assert torch.linalg.det(R).item() == pytest.approx(1.0)
    assert world.objects[0].mesh.volume == pytest.approx((2 - 0.09) * 0.5, rel=1e-6)
    corners = trimesh.creation.box((1, 1, 1)).vertices
    expected = trimesh.transform_points(corners, pose @ stretch)
    found = np.unique(np.round(world_vertices(world, 0), 5), axis=0)
    np.testing.assert_allclose(found, np.unique(np.round(expected, 5), axis=0), atol=2e-5)


def test_a_positive_stretch_keeps_the_rotation_of_the_node(tmp_path: Path):
    pose = pose_of(1, 2, 3, 0.3, -0.2, 0.5)
    scene = trimesh.Scene()
    stretch = np.diag([2.0, 1.0, 0.5, 1.0])
    box = trimesh.creation.box((1, 1, 1))
    scene.add_geometry(box, node_name="a", transform=pose.numpy() @ stretch)
    world = load(saved(scene, tmp_path))
    torch.testing.assert_close(world.objects[0].T_world_object, pose, rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(world.objects[0].mesh.extents, (2, 1, 0.5), rtol=1e-6)


def test_unit_and_pose_of_the_file_give_metres_in_the_world(tmp_path: Path):
    T_file_object, turned = pose_of(0.5, 0, 0, 0, 0, 0), pose_of(0, 0, 0, 0, 0, 0.1)
    in_millimetres = pose_of(500, 0, 0, 0, 0, 0) @ turned
    scene = trimesh.Scene()
    box = trimesh.creation.box((1000, 1000, 1000))
    scene.add_geometry(box, node_name="a", transform=in_millimetres.numpy())
    T_world_file = pose_of(0, 0, 1, math.pi / 2, 0, 0)
    world = load(saved(scene, tmp_path), unit=0.001, T_world_file=T_world_file)
    np.testing.assert_allclose(world.objects[0].mesh.extents, 1.0)
    expected = T_world_file @ T_file_object @ turned
    torch.testing.assert_close(world.objects[0].T_world_object, expected, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("ending", ["stl", "ply", "obj"])
def test_a_file_of_one_mesh_is_an_object_with_its_name(ending: str, tmp_path: Path):
    trimesh.creation.icosphere(subdivisions=2).export(tmp_path / f"ball.{ending}")
    world = load(tmp_path / f"ball.{ending}")
    assert [item.name for item in world.objects] == ["ball"]
    assert world.objects[0].mesh.area == pytest.approx(4 * math.pi, rel=0.05)


def test_objects_of_an_obj_keep_their_names_whatever_materials_they_have(tmp_path: Path):
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 1 0 0\nnewmtl blue\nKd 0 0 1\n")
    triangle = "v {0} 0 0\nv {0} 1 0\nv {0} 0 1\n"
    (tmp_path / "a.obj").write_text(
        f"mtllib a.mtl\no crate_red\n{triangle.format(0)}{triangle.format(1)}"
        "usemtl red\nf 1 2 3\nusemtl blue\nf 4 5 6\n"
        f"o table\n{triangle.format(2)}usemtl red\nf 7 8 9\n"
    )
    objects = {item.name: item.mesh for item in load(tmp_path / "a.obj").objects}
    assert set(objects) == {"crate_red", "table"}
    assert sorted(face_colours(objects["crate_red"])[:, :3].tolist()) == [[0, 0, 255], [255, 0, 0]]


def test_a_gltf_mesh_of_several_materials_is_one_object(tmp_path: Path):
    scene = trimesh.Scene(base_frame="root")
    scene.add_geometry(coloured_box((255, 0, 0)), node_name="crate", geom_name="crate")
    scene.add_geometry(coloured_box((0, 0, 255), 2.0), node_name="lid", geom_name="lid")
    files = export_gltf(scene)
    tree = json.loads(files["model.gltf"])
    both = [mesh["primitives"][0] for mesh in tree["meshes"]]
    tree["meshes"] = [{"name": "crate", "primitives": both}]
    tree["nodes"] = [{"name": "crate", "mesh": 0, "translation": [1, 2, 3]}]
    tree["scenes"] = [{"nodes": [0]}]
    files["model.gltf"] = json.dumps(tree).encode()
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    (item,) = load(tmp_path / "model.gltf").objects
    assert item.name == "crate"
    assert item.T_world_object[:3, 3].tolist() == [1, 2, 3]
    np.testing.assert_allclose(item.mesh.extents, (2, 4, 6))
    assert {tuple(colour) for colour in face_colours(item.mesh)[:, :3]} == {
        (255, 0, 0),
        (0, 0, 255),
    }


def test_faces_without_area_with_nan_or_there_twice_are_dropped(tmp_path: Path):
    corners = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (2, 0, 0), (0, 0, math.nan), (0, 0, 0)]
    good, copied, soup_copy = (0, 1, 2), (2, 0, 1), (5, 2, 1)
    line, point, nan = (0, 1, 3), (0, 5, 1), (0, 1, 4)
    faces = [line, good, copied, point, nan, soup_copy]
    mesh = trimesh.Trimesh(corners, faces, process=False)
    mesh.export(tmp_path / "a.ply")
    (item,) = load(tmp_path / "a.ply").objects
    np.testing.assert_allclose(item.mesh.triangles, [np.array(corners)[list(good)]])


@pytest.mark.parametrize(
    ("name", "content", "found"),
    [
        ("no.glb", None, "no file"),
        ("broken.glb", b"glTF but not really", "cannot be read"),
        ("unknown.xyzw", b"1 2 3", "cannot be read"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles"),
        ("empty.obj", b"", "no triangles"),
    ],
)
def test_a_file_without_triangles_is_a_job_error(
    name: str, content: bytes | None, found: str, tmp_path: Path
):
    file = tmp_path / name
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(JobError, match=found) as caught:
        load(file)
    assert caught.value.file == file


def test_the_real_bin_loads_whole():
    if not EMPTY_BIN.is_file():
        pytest.skip(f"no {EMPTY_BIN}")
    (item,) = load(EMPTY_BIN).objects
    assert len(item.mesh.faces) == pytest.approx(40_000, rel=0.01)
