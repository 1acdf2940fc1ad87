"""The robot: forward kinematics against plain recursion, meshes of links, the two own robots."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from plain_kinematics import link_poses

from torchcal.errors import TorchcalError
from torchcal.geometry import se3
from torchcal.model.meshes import face_colours
from torchcal.model.robot import Robot, load_robot

ROOT = Path(__file__).parents[1]
MED7 = ROOT.parent / "shared" / "jobs" / "lbr_med7" / "robot" / "med7.urdf"
ARM, ROVER = ROOT / "robots" / "arm" / "arm.urdf", ROOT / "robots" / "rover" / "rover.urdf"
ATOL = 1e-13  # a product of ten matrices of size 1 in double precision

MIMIC_CHAIN = """<robot name="fingers">
  <link name="palm"/><link name="a"/><link name="b"/><link name="c"/>
  <joint name="third" type="revolute">
    <parent link="b"/><child link="c"/><origin xyz="0 0 0.1" rpy="0.3 -0.2 0.1"/>
    <axis xyz="1 2 -1"/><limit lower="-1" upper="1"/>
    <mimic joint="second" multiplier="2" offset="0.1"/>
  </joint>
  <joint name="first" type="revolute">
    <parent link="palm"/><child link="a"/><origin xyz="0.1 0 0"/>
    <axis xyz="0 0 2"/><limit lower="-1" upper="1"/>
  </joint>
  <joint name="second" type="prismatic">
    <parent link="a"/><child link="b"/>
    <axis xyz="0 3 4"/><limit lower="-1" upper="1"/>
    <mimic joint="first" multiplier="-0.5" offset="0.2"/>
  </joint>
</robot>"""


def write(folder: Path, text: str) -> Path:
    file = folder / "robot.urdf"
    file.write_text(text)
    return file


@pytest.fixture(params=["med7", "arm", "rover", "mimics of mimics"])
def urdf(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    if request.param == "med7" and not MED7.is_file():
        pytest.skip(f"no {MED7}")
    files = {"med7": MED7, "arm": ARM, "rover": ROVER}
    return files.get(request.param) or write(tmp_path, MIMIC_CHAIN)


def random_joints(robot: Robot, *batch: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    size = (*batch, len(robot.joint_names))
    return torch.randn(size, generator=generator, dtype=torch.float64)


def test_forward_kinematics_is_that_of_plain_recursion(urdf: Path):
    robot = load_robot(urdf)
    for joints in random_joints(robot, 3):
        expected = link_poses(urdf, dict(zip(robot.joint_names, joints.tolist(), strict=True)))
        poses = robot.forward_kinematics(joints)
        assert set(expected) == set(robot.link_names)
        for name, T_base_link in zip(robot.link_names, poses, strict=True):
            torch.testing.assert_close(
                T_base_link, torch.from_numpy(expected[name]), rtol=0.0, atol=ATOL
            )


def test_a_batch_is_its_elements(urdf: Path):
    robot = load_robot(urdf)
    joints = random_joints(robot, 2, 3)
    poses = robot.forward_kinematics(joints)
    assert poses.shape == (2, 3, len(robot.link_names), 4, 4)
    torch.testing.assert_close(poses[1, 2], robot.forward_kinematics(joints[1, 2]))


def test_the_gradient_is_the_numerical_one():
    robot = load_robot(ROVER)
    joints = random_joints(robot).requires_grad_()
    assert torch.autograd.gradcheck(robot.forward_kinematics, joints)


def test_jacobians_are_differences_of_the_links_poses(urdf: Path):
    robot = load_robot(urdf)
    joints, step = random_joints(robot, 2), 1e-6
    poses = robot.forward_kinematics(joints)
    jacobians = robot.jacobians(poses)
    for j in range(len(robot.joint_names)):
        way = step * torch.eye(len(robot.joint_names), dtype=torch.float64)[j]
        ahead, behind = (robot.forward_kinematics(joints + each) for each in (way, -way))
        moved = se3.log(ahead @ se3.inverse(poses)) - se3.log(behind @ se3.inverse(poses))
        expected = moved / (2.0 * step)
        torch.testing.assert_close(jacobians[..., j], expected, rtol=0.0, atol=1e-8)


def test_dtype_follows_the_joints_and_an_empty_batch_stays_empty():
    robot = load_robot(ARM)
    assert robot.forward_kinematics(torch.zeros(6)).dtype == torch.float32
    assert robot.forward_kinematics(torch.zeros(0, 6)).shape == (0, 10, 4, 4)


def test_one_bad_element_leaves_its_neighbours():
    robot = load_robot(ARM)
    joints = random_joints(robot, 3)
    spoilt = joints.clone()
    spoilt[1, 0] = math.nan
    expected, found = robot.forward_kinematics(joints), robot.forward_kinematics(spoilt)
    torch.testing.assert_close(found[[0, 2]], expected[[0, 2]], rtol=0.0, atol=0.0)


def test_a_wrong_number_of_joints_names_the_joints():
    with pytest.raises(ValueError, match=r"found 5 .* expected 6: shoulder_pan, shoulder_lift"):
        load_robot(ARM).forward_kinematics(torch.zeros(5))


def test_links_are_found_by_name():
    robot = load_robot(ARM)
    assert robot.link_names[robot.link_index("depth_optical_frame")] == "depth_optical_frame"
    with pytest.raises(TorchcalError, match=r"'hand'; expected one of base_link, .*tool_flange"):
        robot.link_index("hand")


def test_a_robot_of_one_link_stands_at_its_base(tmp_path: Path):
    robot = load_robot(write(tmp_path, '<robot name="post"><link name="post"/></robot>'))
    assert (robot.joint_names, robot.link_names) == ((), ("post",))
    poses = robot.forward_kinematics(torch.zeros(2, 0, dtype=torch.float64))
    torch.testing.assert_close(poses, torch.eye(4, dtype=torch.float64).expand(2, 1, 4, 4))


def test_the_root_comes_first_and_joints_in_the_order_of_the_file(tmp_path: Path):
    text = MIMIC_CHAIN.replace('<link name="palm"/><link name="a"/>', '<link name="a"/>')
    robot = load_robot(write(tmp_path, text.replace("</robot>", '<link name="palm"/></robot>')))
    assert robot.link_names == ("palm", "a", "b", "c")
    assert robot.joint_names == ("first",)
    assert robot.mimics == {"third": "first", "second": "first"}


def test_limits_are_read_and_continuous_joints_have_none():
    robot = load_robot(ROVER)
    limits = dict(zip(robot.joint_names, robot.joint_limits.tolist(), strict=True))
    assert limits["mast_lift"] == [0.0, 0.3]
    assert limits["mast_tilt"] == [-0.7, 1.0]
    assert limits["mast_pan"] == [-math.inf, math.inf]
    assert robot.joint_kinds == ("continuous", "continuous", "prismatic", "continuous", "revolute")


def test_the_arm_reaches_90_centimetres():
    robot = load_robot(ARM)
    poses = robot.forward_kinematics(torch.zeros(6, dtype=torch.float64))
    shoulder, flange = (
        poses[robot.link_index(name), :3, 3] for name in ("upper_arm_link", "tool_flange")
    )
    torch.testing.assert_close(flange - shoulder, torch.tensor([0.0, 0.0, 0.9]).double())


@pytest.mark.parametrize(
    ("file", "sensor", "carried"),
    [
        (ARM, "depth_optical_frame", ("wrist_2_link", "wrist_3_link", "camera_link")),
        (ROVER, "lidar", ("tilt_link",)),
    ],
)
def test_the_sensor_sees_past_what_carries_it(file: Path, sensor: str, carried: tuple[str, ...]):
    robot = load_robot(file)
    for joints in random_joints(robot, 5):
        poses = robot.forward_kinematics(joints).numpy()
        T_sensor_base = np.linalg.inv(poses[robot.link_index(sensor)])
        for link in carried:
            T = T_sensor_base @ poses[robot.link_index(link)]
            x, y, z = T[:3, :3] @ robot.link_meshes[link].vertices.T + T[:3, 3:]
            inside = (z > 0) & (np.hypot(x, y) < math.tan(math.radians(50.0)) * z)
            assert not inside.any()


def test_optical_frames_look_forwards_with_x_to_the_right():
    robot = load_robot(ROVER)
    T = robot.forward_kinematics(torch.zeros(5, dtype=torch.float64))[robot.link_index("lidar")]
    forwards, left, up = torch.eye(3, dtype=torch.float64)
    torch.testing.assert_close(T[:3, :3], torch.stack([-left, -up, forwards], 1), atol=ATOL, rtol=0)


def test_the_arm_has_the_colours_of_its_three_file_formats():
    meshes = load_robot(ARM).link_meshes
    first = {name: face_colours(mesh)[0, :3].tolist() for name, mesh in meshes.items()}
    assert first["base_link"] == [71, 76, 84]  # the URDF's, on STL
    assert first["upper_arm_link"] == [38, 92, 150]  # the OBJ's material
    assert {tuple(c) for c in face_colours(meshes["camera_link"])[:, :3]} == {
        (168, 174, 180),
        (36, 38, 42),
    }


def test_the_real_arm_loads_with_its_size():
    if not MED7.is_file():
        pytest.skip(f"no {MED7}")
    robot = load_robot(MED7)
    assert sum(len(mesh.faces) for mesh in robot.link_meshes.values()) > 70_000
    parts = robot.forward_kinematics(torch.zeros(7, dtype=torch.float64)).numpy()
    placed = [
        mesh.copy().apply_transform(parts[robot.link_index(name)])
        for name, mesh in robot.link_meshes.items()
    ]
    height = trimesh.util.concatenate(placed).bounds[1, 2]
    assert height == pytest.approx(
        1.266, abs=0.005
    )  # 1.306 less the flange's 0.04 of the data sheet
