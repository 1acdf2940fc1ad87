"""Putting a robot into the folder of a job: its URDF, and every mesh that it shows."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from pathlib import Path

from torchcal.errors import JobError
from torchcal.model.link_meshes import resolve
from torchcal.model.mesh_copy import MeshFolder
from torchcal.model.recordings.recorded import RobotSource
from torchcal.model.regular_file import irregular
from torchcal.model.urdf import copy_files
from torchcal.model.urdf_reader import parse_xml, urdf_of

_PACKAGE = "package://"


def urdf_file(file: Path) -> RobotSource:
    """A URDF in a file.

    Raises:
        JobError: If there is no such file.
    """
    if not file.is_file():
        raise JobError(file, "", irregular(file) or "no such file", "a URDF")
    return RobotSource(xml=file.read_bytes(), named=file)


def copy_robot(source: RobotSource, folder: Path, packages: Mapping[str, Path]) -> Path:
    """Writes a robot's URDF into a folder, and its meshes into ``meshes`` there.

    Args:
        source: The URDF.
        folder: Is made.
        packages: Where the packages are that ``package://`` names mean, by name; others are looked
            for around the URDF and on ROS_PACKAGE_PATH.

    Returns:
        The URDF.

    Raises:
        JobError: If the URDF is broken, or a mesh that it shows is not there.
    """
    root = parse_xml(source.named, source.xml)
    for element in [*root.iter("mesh"), *root.iter("texture")]:
        element.set("filename", _located(element.get("filename", ""), packages))
    _check(source, root)
    folder.mkdir(parents=True, exist_ok=True)
    urdf = folder / "robot.urdf"
    copy_files(source.named, root, MeshFolder(folder / "meshes"))
    ET.ElementTree(root).write(urdf, encoding="utf-8", xml_declaration=True)
    return urdf


def _located(name: str, packages: Mapping[str, Path]) -> str:
    package, _, rest = name.removeprefix(_PACKAGE).partition("/")
    if not name.startswith(_PACKAGE) or package not in packages:
        return name
    return (packages[package] / rest).resolve().as_uri()


def _check(source: RobotSource, root: ET.Element) -> None:
    """The URDF must be sound, and every mesh that a link shows must be there."""
    for link in urdf_of(source.named, root).links:
        for shape in (each for each in link.shapes if each.kind == "mesh"):
            try:
                resolve(source.named, shape.filename, shape.key)
            except JobError as error:
                expected = error.expected
                if error.found.startswith(_PACKAGE):
                    expected += ", or --package NAME=FOLDER, which says where it is"
                raise JobError(error.file, error.key, error.found, expected) from error


def urdf_links(source: RobotSource) -> list[str]:
    """The names of a URDF's links, its root first.

    Raises:
        JobError: If the URDF is broken.
    """
    root = parse_xml(source.named, source.xml)
    links = [each.get("name", "") for each in root.findall("link")]
    children = {child.get("link") for child in root.findall("joint/child")}
    return sorted(links, key=lambda name: name in children)


def moving_joints(source: RobotSource) -> list[str]:
    """The names of a URDF's joints that have a value of their own.

    Raises:
        JobError: If the URDF is broken.
    """
    root = parse_xml(source.named, source.xml)
    return [
        joint.get("name", "")
        for joint in root.findall("joint")
        if joint.get("type") != "fixed" and joint.find("mimic") is None
    ]
