"""The files of a job."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from cylinders.images import range_image
from cylinders.recording import View

AXES = {"x": "1 0 0", "y": "0 1 0", "z": "0 0 1", "yaw": "0 0 1", "pitch": "0 1 0", "roll": "1 0 0"}
"""The joints that stand for the robot: R = Rz(yaw) Ry(pitch) Rx(roll), then the flange."""
SLIDES = 3
"""The first of them are prismatic."""
BEYOND = (0.05, 0.3)
"""m, rad: limits lie so far beyond the recorded values."""
BORDER = 4
"""Pixels around all that was seen."""

Pose = tuple[np.ndarray, np.ndarray]
"""xyz (m); roll, pitch, yaw (degrees)."""


def write_images(
    folder: Path, views: Sequence[View], sides: Sequence[np.ndarray], focal: float
) -> str:
    """Writes depth and masks; returns the keys of the sensor that they have in common."""
    seen = np.concatenate([focal * view.points[:, :2] / view.points[:, 2:] for view in views])
    low = np.floor(seen.min(0)) - BORDER
    width, height = (np.ceil(seen.max(0)) + BORDER - low).astype(int).tolist()
    for number, (view, side) in enumerate(zip(views, sides, strict=True), start=1):
        depth, mask = range_image(
            view.points, side, focal=focal, centre=-low, shape=(height, width)
        )
        np.save(folder / f"{number}.npy", depth.astype(np.float32))
        Image.fromarray(np.where(mask, 255, 0).astype(np.uint8)).save(folder / f"{number}-mask.png")
    ranges = np.concatenate([view.points[:, 2] for view in views])
    near, far = 0.5 * ranges.min(), 1.5 * ranges.max()
    return f"""model = "pinhole"
width = {width}
height = {height}
fx = {focal:g}
fy = {focal:g}
cx = {-low[0]:g}
cy = {-low[1]:g}
range = [{near:.2f}, {far:.2f}]
"""


def write_tube(file: Path, *, radius: float, length: float, sections: int) -> None:
    """The side of a cylinder about z, without ends."""
    angle = 2.0 * np.pi * np.arange(sections) / sections
    # Corners outside and middles inside: the strips' mean radius is the cylinder's.
    outer = radius * (1.0 + (np.pi / sections) ** 2 / 6.0)
    ring = outer * np.stack([np.cos(angle), np.sin(angle), 0.0 * angle], 1)
    half = np.array([0.0, 0.0, 0.5 * length])
    here = np.arange(sections)
    there = (here + 1) % sections
    lower = np.stack([here, there, there + sections], 1)
    upper = np.stack([here, there + sections, here + sections], 1)
    corners, faces = np.concatenate([ring - half, ring + half]), np.concatenate([lower, upper])
    tube = trimesh.Trimesh(corners, faces, process=False)
    trimesh.Scene({"cylinder": tube}).export(file)


def urdf_text(views: Sequence[View]) -> str:
    """Three slides and three turns that carry the flange, each alone on its joint."""
    values = np.stack([view.flange for view in views])
    links = ["base", *(f"after_{name}" for name in list(AXES)[:-1]), "flange"]
    lines = ["<robot name='flange_poses'>", *(f"  <link name='{name}'/>" for name in links)]
    for place, (name, axis) in enumerate(AXES.items()):
        kind, beyond = ("prismatic", BEYOND[0]) if place < SLIDES else ("revolute", BEYOND[1])
        low, high = values[:, place].min() - beyond, values[:, place].max() + beyond
        lines += [
            f"  <joint name='{name}' type='{kind}'>",
            f"    <parent link='{links[place]}'/><child link='{links[place + 1]}'/>",
            f"    <axis xyz='{axis}'/>",
            f"    <limit lower='{low:.4f}' upper='{high:.4f}' effort='1' velocity='1'/>",
            "  </joint>",
        ]
    return "\n".join([*lines, "</robot>", ""])


def job_text(
    views: Sequence[View],
    *,
    optics: str,
    sigma: float,
    mount: Pose,
    cylinder: Pose,
    believed: tuple[float, float],
    hold: bool,
) -> str:
    """The job file.

    Args:
        views: For the joints of each frame.
        optics: Keys of the sensor.
        sigma: Of a pixel (m).
        mount: T_flange_camera.
        cylinder: T_base_cylinder, its axis along z.
        believed: Sigmas of both (m, degrees).
        hold: Whether the slide along the axis and the turn about it are taken for known.
    """
    position, rotation = believed
    along = [0.0 if hold else sigma for sigma in believed]
    frames = "".join(
        f"""
[[frame]]
depth = "{number}.npy"
mask = "{number}-mask.png"
joints = {{ {", ".join(f"{n} = {v:.9g}" for n, v in zip(AXES, view.flange, strict=True))} }}
"""
        for number, view in enumerate(views, start=1)
    )
    return f"""# A camera on a flange saw a cylinder. Masks mark the pixels that show its side; the
# model is a longer tube without ends. The robot is known by its flange's poses alone.
[world]
model = "cylinder.glb"
pose = {_pose_text(cylinder)}

[robot]
urdf = "flange.urdf"

[sensor]
link = "flange"
mount = {_pose_text(mount)}
{optics}sigma = {sigma:g}
drift = 0
beam = 1
{frames}
[unknown.mount]
position_sigma = {position:g}
rotation_sigma_deg = {rotation:g}

[unknown.object.cylinder]
position_sigma = [{position:g}, {position:g}, {along[0]:g}]
rotation_sigma_deg = [{rotation:g}, {rotation:g}, {along[1]:g}]
"""


def _pose_text(pose: Pose) -> str:
    xyz, rpy = ([round(value, 6) + 0.0 for value in part.tolist()] for part in pose)
    return f"{{ xyz = {xyz}, rpy_deg = {rpy} }}"
