"""Forward kinematics of a URDF without torchcal: plain recursion over the XML, as an oracle."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


def link_poses(urdf: Path, values: dict[str, float]) -> dict[str, NDArray[np.float64]]:
    """T_base_link of every link; joints that are left out are 0."""
    root = ET.parse(urdf).getroot()
    joints = root.findall("joint")
    children = {_end(joint, "child") for joint in joints}
    links = [link.attrib["name"] for link in root.findall("link")]
    base = next(link for link in links if link not in children)
    poses = {base: np.eye(4)}

    def descend(link: str) -> None:
        for joint in joints:
            if _end(joint, "parent") == link:
                child = _end(joint, "child")
                poses[child] = poses[link] @ _origin(joint) @ _motion(joint, joints, values)
                descend(child)

    descend(base)
    return poses


def _end(joint: ET.Element, which: str) -> str:
    element = joint.find(which)
    assert element is not None
    return element.attrib["link"]


def _triple(element: ET.Element | None, name: str, default: str) -> NDArray[np.float64]:
    text = default if element is None else element.get(name, default)
    return np.array([float(word) for word in text.split()])


def _pose(R: NDArray[np.float64], t: NDArray[np.float64]) -> NDArray[np.float64]:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def _origin(joint: ET.Element) -> NDArray[np.float64]:
    origin = joint.find("origin")
    R = Rotation.from_euler("xyz", _triple(origin, "rpy", "0 0 0")).as_matrix()
    return _pose(R, _triple(origin, "xyz", "0 0 0"))


def _value(joint: ET.Element, joints: list[ET.Element], values: dict[str, float]) -> float:
    mimic = joint.find("mimic")
    if mimic is None:
        return values.get(joint.attrib["name"], 0.0)
    leader = next(other for other in joints if other.get("name") == mimic.get("joint"))
    followed = _value(leader, joints, values)
    return float(mimic.get("multiplier", 1)) * followed + float(mimic.get("offset", 0))


def _motion(
    joint: ET.Element, joints: list[ET.Element], values: dict[str, float]
) -> NDArray[np.float64]:
    if joint.get("type") == "fixed":
        return np.eye(4)
    axis = _triple(joint.find("axis"), "xyz", "1 0 0")
    axis = axis / np.linalg.norm(axis)
    value = _value(joint, joints, values)
    if joint.get("type") == "prismatic":
        return _pose(np.eye(3), value * axis)
    return _pose(Rotation.from_rotvec(value * axis).as_matrix(), np.zeros(3))
