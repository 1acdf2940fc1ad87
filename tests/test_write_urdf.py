"""The written URDF: base and sensor where they were found, the folder whole, others can read it."""

import math
import shutil
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import torch
import yourdfpy
from PIL import Image

from torchcal.errors import TorchcalError
from torchcal.geometry import se3
from torchcal.model.meshes import face_colours
from torchcal.model.robot import load_robot
from torchcal.model.urdf import write_urdf

ROOT = Path(__file__).parents[1]
ARM, ROVER = ROOT / "robots" / "arm" / "arm.urdf", ROOT / "robots" / "rover" / "rover.urdf"
POSE_ATOL = 1e-9  # what the written pose must be reproduced to


def write(folder: Path, text: str) -> Path:
    file = folder / "robot.urdf"
    file.write_text(text)
    return file


def random_pose(seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return se3.exp(torch.randn(6, generator=generator, dtype=torch.float64))


def steep_pose() -> torch.Tensor:
    """Pitch nearly 90 degrees, where roll and yaw are hard to tell apart."""
    rpy = torch.tensor([0.3, math.pi / 2 - 2e-8, 0.7], dtype=torch.float64)
    return se3.from_xyz_rpy(torch.ones(3, dtype=torch.float64), rpy)


@pytest.mark.parametrize("link", ["wrist_3_link", "world"])
@pytest.mark.parametrize("T_world_base", [random_pose(1), steep_pose()])
def test_the_written_urdf_holds_base_and_sensor(
    link: str, T_world_base: torch.Tensor, tmp_path: Path
):
    arm, T_link_sensor = load_robot(ARM), random_pose(2)
    out = tmp_path / "out" / "robot.urdf"
    write_urdf(arm, out, T_world_base=T_world_base, link=link, T_link_sensor=T_link_sensor)
    written = load_robot(out)
    assert written.link_names == ("world", *arm.link_names, "torchcal_sensor")
    assert written.joint_names == arm.joint_names
    joints = torch.linspace(-1, 1, 6, dtype=torch.float64)
    before, after = arm.forward_kinematics(joints), written.forward_kinematics(joints)
    torch.testing.assert_close(after[1:-1], T_world_base @ before, rtol=0.0, atol=POSE_ATOL)
    T_world_link = torch.eye(4).double() if link == "world" else after[written.link_index(link)]
    torch.testing.assert_close(after[-1], T_world_link @ T_link_sensor, rtol=0.0, atol=POSE_ATOL)


@pytest.mark.parametrize("urdf", [ARM, ROVER])
def test_the_written_urdf_contains_the_offsets_of_joints_and_limits(urdf: Path, tmp_path: Path):
    """At the values that the joints report, links stand where the offsets put them."""
    robot = load_robot(urdf)
    offsets = torch.linspace(-0.1, 0.2, len(robot.joint_names), dtype=torch.float64)
    out, eye = tmp_path / "robot.urdf", torch.eye(4, dtype=torch.float64)
    named = dict(zip(robot.joint_names, offsets.tolist(), strict=True))
    write_urdf(robot, out, T_world_base=eye, link="world", T_link_sensor=eye, joint_offsets=named)
    written = load_robot(out)
    reported = torch.linspace(-0.4, 0.5, len(offsets), dtype=torch.float64)
    torch.testing.assert_close(
        written.forward_kinematics(reported)[1:-1],
        robot.forward_kinematics(reported + offsets),
        rtol=0.0,
        atol=POSE_ATOL,
    )
    limits = robot.joint_limits - offsets[:, None]
    torch.testing.assert_close(written.joint_limits, limits, rtol=0.0, atol=POSE_ATOL)


def test_soft_limits_and_reference_positions_move_with_the_zero_of_their_joint(tmp_path: Path):
    text = ARM.read_text()
    extra = (
        '<safety_controller soft_lower_limit="-1" soft_upper_limit="2" k_velocity="3"/>'
        '<calibration rising="0.25"/>'
    )
    root = ET.fromstring(text)
    moving = next(each for each in root.findall("joint") if each.get("type") == "revolute")
    name = moving.get("name", "")
    moving.extend(ET.fromstring(f"<joint>{extra}</joint>"))
    shutil.copytree(ARM.parent, tmp_path / "arm")
    file = tmp_path / "arm" / "arm.urdf"
    file.write_text(ET.tostring(root, encoding="unicode"))
    out, eye = tmp_path / "robot.urdf", torch.eye(4, dtype=torch.float64)
    write_urdf(
        load_robot(file),
        out,
        T_world_base=eye,
        link="world",
        T_link_sensor=eye,
        joint_offsets={name: 0.125},
    )
    written = ET.parse(out).getroot().findall("joint")
    found = next(each for each in written if each.get("name") == name)
    soft, reference = found.find("safety_controller"), found.find("calibration")
    assert soft is not None
    assert reference is not None
    assert soft.attrib == {
        "soft_lower_limit": "-1.125",
        "soft_upper_limit": "1.875",
        "k_velocity": "3",
    }
    assert reference.attrib == {"rising": "0.125"}


def test_an_offset_of_no_joint_is_an_error(tmp_path: Path):
    eye = torch.eye(4, dtype=torch.float64)
    with pytest.raises(TorchcalError, match=r"found joint 'knee'; expected .*elbow"):
        write_urdf(
            load_robot(ARM),
            tmp_path / "robot.urdf",
            T_world_base=eye,
            link="world",
            T_link_sensor=eye,
            joint_offsets={"knee": 0.1},
        )
    assert not (tmp_path / "robot.urdf").exists()


def test_the_written_folder_is_whole_without_the_original(tmp_path: Path):
    (tmp_path / "arm").mkdir()
    source = shutil.copytree(ARM.parent, tmp_path / "source" / "arm") / "arm.urdf"
    arm, out = load_robot(source), tmp_path / "out" / "robot.urdf"
    write_urdf(arm, out, T_world_base=random_pose(1), link="world", T_link_sensor=random_pose(2))
    shutil.rmtree(tmp_path / "source")
    written = load_robot(out)
    for name, mesh in arm.link_meshes.items():
        np.testing.assert_array_equal(written.link_meshes[name].vertices, mesh.vertices)
        np.testing.assert_array_equal(face_colours(written.link_meshes[name]), face_colours(mesh))


def test_another_program_reads_the_written_urdf(tmp_path: Path):
    rover, T_world_base = load_robot(ROVER), random_pose(1)
    out = tmp_path / "robot.urdf"
    write_urdf(rover, out, T_world_base=T_world_base, link="lidar", T_link_sensor=random_pose(2))
    other = yourdfpy.URDF.load(str(out), load_meshes=False, build_scene_graph=True)
    other.update_cfg(np.zeros(len(other.actuated_joint_names)))
    found = other.get_transform("torchcal_sensor", "world")
    poses = rover.forward_kinematics(torch.zeros(5, dtype=torch.float64))
    expected = T_world_base @ poses[rover.link_index("lidar")] @ random_pose(2)
    torch.testing.assert_close(torch.tensor(found), expected, rtol=0.0, atol=POSE_ATOL)


GANTRY = """<robot name="gantry"><link name="foot"/><link name="cart"/><link name="head"/>
  <joint name="slide" type="prismatic"><parent link="foot"/><child link="cart"/>
    <origin xyz="0 0 0.1" rpy="0.1 -0.2 0.3"/><axis xyz="1 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <joint name="nod" type="revolute"><parent link="cart"/><child link="head"/>
    <axis xyz="0 0 1.0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>"""


def test_another_program_slides_as_far_along_an_axis_that_was_no_unit_vector(tmp_path: Path):
    gantry = load_robot(write(tmp_path, GANTRY))
    out = tmp_path / "out" / "robot.urdf"
    eye = torch.eye(4, dtype=torch.float64)
    offsets = {"slide": 0.02}
    write_urdf(gantry, out, T_world_base=eye, link="head", T_link_sensor=eye, joint_offsets=offsets)
    assert '<axis xyz="0 0 1.0"' in out.read_text()  # what is a unit vector stays as written
    other = yourdfpy.URDF.load(str(out), load_meshes=False, build_scene_graph=True)
    other.update_cfg({"slide": 0.4, "nod": 0.3})
    found = other.get_transform("torchcal_sensor", "world")
    poses = gantry.forward_kinematics(torch.tensor([0.42, 0.3], dtype=torch.float64))
    expected = poses[gantry.link_index("head")]
    torch.testing.assert_close(torch.tensor(found), expected, rtol=0.0, atol=POSE_ATOL)


def test_taken_names_are_not_used_again(tmp_path: Path):
    source = write(tmp_path, '<robot name="r"><link name="world"/></robot>')
    pose = random_pose(1)
    for turn in range(3):
        out = tmp_path / f"{turn}.urdf"
        write_urdf(load_robot(source), out, T_world_base=pose, link="world", T_link_sensor=pose)
        source = out
    assert load_robot(source).link_names == (
        *("torchcal_world_3", "world", "torchcal_world", "torchcal_sensor"),
        *("torchcal_world_2", "torchcal_sensor_2", "torchcal_sensor_3"),
    )


def test_materials_and_images_of_meshes_come_along_under_names_of_their_own(tmp_path: Path):
    shapes = []
    for folder, colour in (("red", (255, 0, 0)), ("blue", (0, 0, 255))):
        (tmp_path / folder / "images").mkdir(parents=True)
        Image.new("RGB", (4, 4), colour).save(tmp_path / folder / "images" / "skin.png")
        (tmp_path / folder / "a.mtl").write_text("newmtl m\nmap_Kd images/skin.png\n")
        (tmp_path / folder / "a.obj").write_text(
            "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\n"
            "usemtl m\nf 1/1 2/2 3/3\n"
        )
        shapes.append(f'<visual><geometry><mesh filename="{folder}/a.obj"/></geometry></visual>')
    source = write(tmp_path, f'<robot name="r"><link name="a">{"".join(shapes)}</link></robot>')
    out = tmp_path / "out" / "robot.urdf"
    pose = random_pose(1)
    write_urdf(load_robot(source), out, T_world_base=pose, link="world", T_link_sensor=pose)
    for folder in ("red", "blue"):
        shutil.rmtree(tmp_path / folder)
    colours = face_colours(load_robot(out).link_meshes["a"])[:, :3]
    np.testing.assert_array_equal(colours, [(255, 0, 0), (0, 0, 255)])


def test_a_sensor_on_an_unknown_link_is_an_error_and_nothing_is_written(tmp_path: Path):
    pose, out = random_pose(1), tmp_path / "out" / "robot.urdf"
    with pytest.raises(TorchcalError, match="'hand'"):
        write_urdf(load_robot(ARM), out, T_world_base=pose, link="hand", T_link_sensor=pose)
    assert not out.parent.exists()
