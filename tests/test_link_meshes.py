"""Meshes of links: in metres in the link's frame, with colours, found wherever ROS puts them."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from trimesh.exchange.dae import export_collada

from torchcal.errors import JobError
from torchcal.model.meshes import face_colours
from torchcal.model.paint import paint_of
from torchcal.model.robot import load_robot

RED = '<material name="red"><color rgba="1 0 0 1"/></material>'
JOINT = '<joint name="j" type="fixed"><parent link="a"/><child link="b"/></joint>'


def visual(geometry: str, extra: str = "") -> str:
    shape = f"<visual>{extra}<geometry>{geometry}</geometry></visual>"
    return f'<robot name="r"><link name="a">{shape}</link></robot>'


def write(folder: Path, text: str) -> Path:
    file = folder / "robot.urdf"
    file.write_text(text)
    return file


@pytest.mark.parametrize("content", [b"solid x", b"", b"\x00" * 100])
def test_a_broken_mesh_is_a_job_error(content: bytes, tmp_path: Path):
    (tmp_path / "a.stl").write_bytes(content)
    with pytest.raises(JobError, match=r"visual\[0\].geometry.mesh.filename: found a.stl"):
        load_robot(write(tmp_path, visual('<mesh filename="a.stl"/>')))


def link_mesh(folder: Path, geometry: str, extra: str = "") -> trimesh.Trimesh:
    return load_robot(write(folder, visual(geometry, extra))).link_meshes["a"]


def test_primitives_have_their_size_to_less_than_a_millimetre(tmp_path: Path):
    box = link_mesh(tmp_path, '<box size="1 2 3"/>')
    np.testing.assert_allclose(box.extents, (1, 2, 3))
    cylinder = link_mesh(tmp_path, '<cylinder radius="1" length="3"/>')
    np.testing.assert_allclose(cylinder.extents, (2, 2, 3), atol=1e-3)
    assert cylinder.volume == pytest.approx(3 * math.pi, rel=1e-3)
    sphere = link_mesh(tmp_path, '<sphere radius="0.1"/>')
    middles = np.linalg.norm(sphere.triangles_center, axis=1)
    assert middles.min() > 0.1 - 1e-3


def test_origin_and_scale_are_applied_and_a_mirrored_mesh_still_looks_outwards(tmp_path: Path):
    trimesh.creation.box((1, 1, 1)).apply_translation((0.5, 0.5, 0.5)).export(tmp_path / "a.stl")
    quarter = f'<origin xyz="10 0 0" rpy="0 0 {math.pi / 2}"/>'
    mesh = link_mesh(tmp_path, '<mesh filename="a.stl" scale="-2 1 0.5"/>', quarter)
    np.testing.assert_allclose(mesh.bounds, [(9, -2, 0), (10, 0, 0.5)], atol=1e-7)
    assert mesh.volume == pytest.approx(1.0, rel=1e-6)


def test_collision_geometry_stands_in_where_there_is_no_visual(tmp_path: Path):
    text = visual('<box size="1 1 1"/>').replace("visual", "collision")
    assert load_robot(write(tmp_path, text)).link_meshes["a"].volume == pytest.approx(1.0)
    both = text.replace(
        "</link>", '<visual><geometry><sphere radius="9"/></geometry></visual></link>'
    )
    np.testing.assert_allclose(load_robot(write(tmp_path, both)).link_meshes["a"].extents, 18)


def test_a_material_that_another_link_defines_gives_the_colour(tmp_path: Path):
    text = visual('<box size="1 1 1"/>', '<material name="red"/>')
    other = '<link name="b"><visual><geometry><sphere radius="1"/></geometry><material name="red">'
    other += '<color rgba="1 0 0.2 1"/></material></visual></link>'
    file = write(tmp_path, text.replace("</robot>", f"{other}{JOINT}</robot>"))
    colours = face_colours(load_robot(file).link_meshes["a"])
    assert (colours == (255, 0, 51, 255)).all()


@pytest.mark.parametrize(("unit", "factor"), [("1", 1.0), ("0.001", 1e-3), ("0.0254", 0.0254)])
def test_collada_is_scaled_by_its_unit_and_not_turned(unit: str, factor: float, tmp_path: Path):
    text = export_collada(trimesh.creation.box((1, 2, 3))).decode()
    text = text.replace("<up_axis>Y_UP", f'<unit name="u" meter="{unit}"/><up_axis>Y_UP')
    (tmp_path / "a.dae").write_text(text)
    mesh = link_mesh(tmp_path, '<mesh filename="a.dae"/>')
    np.testing.assert_allclose(mesh.extents, np.array((1, 2, 3)) * factor, rtol=1e-6)


@pytest.mark.parametrize("where", ["around the URDF", "on ROS_PACKAGE_PATH", "by file://"])
def test_meshes_are_found_in_packages(where: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    package = tmp_path / "ws" / "my_robot"
    (package / "urdf").mkdir(parents=True)
    trimesh.creation.box((1, 1, 1)).export(package / "a b.stl")
    folder, name = package / "urdf", "package://my_robot/a%20b.stl"
    if where == "on ROS_PACKAGE_PATH":
        folder = tmp_path
        monkeypatch.setenv("ROS_PACKAGE_PATH", f"/nowhere:{tmp_path / 'ws'}")
    if where == "by file://":
        name = f"file://{package}/a%20b.stl"
    assert link_mesh(folder, f'<mesh filename="{name}"/>').volume == pytest.approx(1.0)


def test_a_link_keeps_its_texture_and_a_colour_of_the_urdf_replaces_it(tmp_path: Path):
    Image.new("RGB", (2, 2), (10, 200, 30)).save(tmp_path / "skin.png")
    (tmp_path / "a.mtl").write_text("newmtl m\nmap_Kd skin.png\n")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    own = paint_of(link_mesh(tmp_path, '<mesh filename="a.obj"/>'))
    assert [image[0, 0].tolist() for image in own.images] == [[10, 200, 30]]
    text = visual('<mesh filename="a.obj"/>').replace("</visual>", f"{RED}</visual>")
    painted = paint_of(load_robot(write(tmp_path, text)).link_meshes["a"])
    assert painted.images == ()
    assert (painted.colour == torch.tensor([1.0, 0.0, 0.0])).all()
