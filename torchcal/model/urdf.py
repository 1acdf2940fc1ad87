"""Writing the corrected URDF. Reading is in ``torchcal.model.urdf_reader``."""

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Mapping
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from torchcal.errors import JobError
from torchcal.geometry import se3
from torchcal.model.job import WORLD_LINK
from torchcal.model.link_meshes import resolve
from torchcal.model.mesh_copy import MeshFolder
from torchcal.model.robot import JointMotion, Robot
from torchcal.model.urdf_reader import read_xml

SENSOR_LINK = "torchcal_sensor"
GIVEN_VALUES = {
    "safety_controller": ("soft_lower_limit", "soft_upper_limit"),
    "calibration": ("rising", "falling"),
}
"""Values of a joint that say nothing where they are left out."""
ROUNDING = 1e-12
"""What the length of a unit vector may differ from 1."""


def write_urdf(
    robot: Robot,
    file: Path,
    *,
    T_world_base: Float[Tensor, "4 4"],
    link: str,
    T_link_sensor: Float[Tensor, "4 4"],
    joint_offsets: Mapping[str, float] | None = None,
) -> None:
    """Writes the robot's URDF with where its base stands, its joints are 0 and its sensor is.

    The tree stays as it was, and limits, soft limits and reference positions move with the zero of
    their joint; axes that are not of length 1, which programs read differently, become so. New are
    a root link ``world`` (``torchcal_world`` where that name is taken) with a fixed joint to the
    old root, and a link ``torchcal_sensor`` fixed to the link that carries the sensor. Mesh files
    are copied to ``meshes`` beside the file, with the materials and images that they name.

    Args:
        robot: As ``load_robot`` read it; its file is read again.
        file: The URDF to write.
        T_world_base: Where the root link stands in the world (m).
        link: The link that carries the sensor; ``WORLD_LINK`` for one that stands still.
        T_link_sensor: Where the sensor is on it (m).
        joint_offsets: What must be added to the values of joints (rad, m): their origins hold it
            afterwards, and those of the joints that follow them.

    Raises:
        TorchcalError: If the robot has no such link, or its file can no longer be read.
    """
    if link != WORLD_LINK:
        robot.link_index(link)
    root = read_xml(robot.file)
    _set_unit_axes(root)
    for child, motion in robot.joint_motions(joint_offsets or {}).items():
        _shift_joint(root, child, motion)
    copy_files(robot.file, root, MeshFolder(file.parent / "meshes"))
    links = {element.get("name", "") for element in root.findall("link")}
    joints = {element.get("name", "") for element in root.findall("joint")}
    world = WORLD_LINK if WORLD_LINK not in links else _free("torchcal_world", links)
    sensor = _free(SENSOR_LINK, links)
    carrier = world if link == WORLD_LINK else link
    base = _free("torchcal_base_joint", joints)
    mount = _free("torchcal_sensor_joint", joints)
    new = [
        ET.Element("link", name=world),
        _fixed_joint(base, world, robot.link_names[0], T_world_base),
        ET.Element("link", name=sensor),
        _fixed_joint(mount, carrier, sensor, T_link_sensor),
    ]
    root.extend(new)
    ET.indent(root)
    file.parent.mkdir(parents=True, exist_ok=True)
    ET.ElementTree(root).write(file, encoding="utf-8", xml_declaration=True)


def _shift_joint(root: ET.Element, child: str, motion: JointMotion) -> None:
    """Puts an offset into the origin of the joint above a link, and takes it out of its values."""
    joint = next(joint for joint in root.findall("joint") if _child(joint) == child)
    origin = joint.find("origin")
    if origin is None:
        origin = ET.SubElement(joint, "origin")
    xyz, rpy = (
        torch.tensor([float(x) for x in origin.get(key, "0 0 0").split()], dtype=torch.float64)
        for key in ("xyz", "rpy")
    )
    _set_origin(origin, se3.from_xyz_rpy(xyz, rpy) @ motion.T)
    for element, key in _values(joint):
        element.set(key, f"{float(element.get(key, '0')) - motion.value:.17g}")


def _set_unit_axes(root: ET.Element) -> None:
    """Makes axes unit vectors: along a longer one some programs slide farther than the value."""
    for axis in root.findall("joint/axis"):
        xyz = torch.tensor([float(x) for x in axis.get("xyz", "1 0 0").split()]).double()
        length = float(xyz.norm())
        if length > 0.0 and abs(length - 1.0) > ROUNDING:
            axis.set("xyz", _digits(xyz / length))


def _values(joint: ET.Element) -> Iterator[tuple[ET.Element, str]]:
    """Attributes of a joint's parts that are values of the joint: they move with its zero."""
    if joint.get("type") != "continuous":
        for limit in joint.findall("limit"):
            yield from ((limit, key) for key in ("lower", "upper"))  # 0 if left out
    for tag, keys in GIVEN_VALUES.items():
        for element in joint.findall(tag):
            yield from ((element, key) for key in keys if key in element.attrib)


def _child(joint: ET.Element) -> str | None:
    element = joint.find("child")
    return None if element is None else element.get("link")


def _set_origin(origin: ET.Element, T: Float[Tensor, "4 4"]) -> None:
    xyz, rpy = se3.to_xyz_rpy(T.detach().cpu().double())
    origin.set("xyz", _digits(xyz))
    origin.set("rpy", _digits(rpy))


def _free(name: str, taken: set[str]) -> str:
    """The name, or with a number that makes it new."""
    count, free = 1, name
    while free in taken:
        count += 1
        free = f"{name}_{count}"
    return free


def _fixed_joint(name: str, parent: str, child: str, T_parent_child: Tensor) -> ET.Element:
    joint = ET.Element("joint", name=name, type="fixed")
    _set_origin(ET.SubElement(joint, "origin"), T_parent_child)
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=child)
    return joint


def _digits(values: Tensor) -> str:
    """All 17 digits of a double: reading gives the same bits."""
    return " ".join(f"{value:.17g}" for value in values.tolist())


def copy_files(urdf: Path, root: ET.Element, folder: MeshFolder) -> None:
    """Copies every file that a URDF names, and names the copies in it.

    Args:
        urdf: The file, around which those that it names are looked for.
        root: Its ``<robot>`` element; collision meshes that are not there stay as named.
        folder: Takes the copies; it must be beside the file that ``root`` will be written to.
    """
    for element in [*root.iter("mesh"), *root.iter("texture")]:
        name = element.get("filename", "")
        try:
            source = resolve(urdf, name, element.tag)
        except JobError:
            continue
        element.set("filename", f"{folder.folder.name}/{folder.add(source)}")
