"""Writing the world: names, poses, geometry, colours and textures come back."""

from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial
from world_files import coloured_box, load, pose_of, saved, world_vertices

from torchcal.errors import JobError
from torchcal.model.meshes import face_colours, painted
from torchcal.model.world import World, WorldObject, read_extras, write_world

EYE = (0.0,) * 6
ATOL_FILE = 1e-6  # GLB holds coordinates of about 1 m in single precision


def rewritten(world: World, folder: Path) -> World:
    write_world(world, folder / "written.glb")
    return load(folder / "written.glb")


def test_textures_are_kept_and_sampled_for_each_face(tmp_path: Path):
    image = Image.new("RGB", (2, 1))
    image.putpixel((0, 0), (255, 0, 0))
    image.putpixel((1, 0), (0, 0, 255))
    vertices = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)]
    uv = np.array([[0.1, 0.5]] * 3 + [[0.9, 0.5]] * 3)
    visual = TextureVisuals(uv=uv, material=PBRMaterial(baseColorTexture=image))
    mesh = trimesh.Trimesh(vertices, [(0, 1, 2), (3, 4, 5)], visual=visual, process=False)
    file = saved(trimesh.Scene({"sheet": mesh}), tmp_path)
    for world in (load(file), rewritten(load(file), tmp_path)):
        assert isinstance(world.objects[0].mesh.visual, TextureVisuals)
        colours = face_colours(world.objects[0].mesh)[:, :3]
        np.testing.assert_array_equal(colours, [(255, 0, 0), (0, 0, 255)])


def test_the_texture_of_an_obj_is_as_bright_after_writing(tmp_path: Path):
    Image.new("RGB", (2, 2), (10, 200, 30)).save(tmp_path / "skin.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 0.5 0.5 0.5\nmap_Kd skin.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    before = load(tmp_path / "a.obj")
    for world in (before, rewritten(before, tmp_path)):
        assert face_colours(world.objects[0].mesh)[0, :3].tolist() == [10, 200, 30]


def test_writing_gives_names_poses_geometry_and_colours_back(tmp_path: Path):
    colours = np.arange(48, dtype=np.uint8).reshape(12, 4) | np.array(
        [0, 0, 0, 255], dtype=np.uint8
    )
    motley = painted(trimesh.creation.box((1, 1, 1)), colours)
    meshes = {"crate": coloured_box((9, 99, 199)), "motley": motley, "world": motley.copy()}
    before = World(
        objects=tuple(
            WorldObject(
                name=name, mesh=mesh, T_world_object=pose_of(len(name), 2, 3, 0.3, -0.2, 2.5)
            )
            for name, mesh in meshes.items()
        )
    )
    after = rewritten(before, tmp_path)
    assert [item.name for item in after.objects] == list(meshes)
    for index, (old, new) in enumerate(zip(before.objects, after.objects, strict=True)):
        torch.testing.assert_close(old.T_world_object, new.T_world_object, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(
            world_vertices(before, index), world_vertices(after, index), atol=ATOL_FILE
        )
        np.testing.assert_array_equal(face_colours(old.mesh), face_colours(new.mesh))


def test_only_glb_is_written(tmp_path: Path):
    with pytest.raises(ValueError, match=r"expected a name that ends in \.glb"):
        write_world(World(objects=()), tmp_path / "a.obj")
    assert list(tmp_path.iterdir()) == []


def test_a_world_of_nothing_is_a_file_that_says_so(tmp_path: Path):
    write_world(World(objects=()), tmp_path / "a.glb", {"why": ["all of it is gone"]})
    assert read_extras(tmp_path / "a.glb") == {"why": ["all of it is gone"]}
    with pytest.raises(JobError, match="no triangles"):
        load(tmp_path / "a.glb")


def test_what_a_file_says_of_an_object_is_read_and_written_again(tmp_path: Path):
    said = {"torchcal": [{"change": "add", "evidence": {"supporting": 3}}]}
    mesh, T = trimesh.creation.box((1, 1, 1)), pose_of(1, 2, 3, 0, 0, 0)
    world = World(
        objects=(
            WorldObject(name="new", mesh=mesh, T_world_object=T, extras=said),
            WorldObject(name="old", mesh=mesh, T_world_object=T),
        )
    )
    for again in (rewritten(world, tmp_path), rewritten(rewritten(world, tmp_path), tmp_path)):
        assert {item.name: item.extras for item in again.objects} == {"new": said, "old": {}}


def test_a_file_is_whole_or_the_old_one(tmp_path: Path, monkeypatch):
    before = World(
        objects=(WorldObject(name="a", mesh=coloured_box((1, 2, 3)), T_world_object=pose_of(*EYE)),)
    )
    write_world(before, tmp_path / "a.glb")
    old = (tmp_path / "a.glb").read_bytes()

    def half(self: Path, data: bytes) -> int:
        with self.open("wb") as file:
            file.write(data[: len(data) // 2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(KeyboardInterrupt):
        write_world(World(objects=()), tmp_path / "a.glb")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == {"a.glb": old}
