"""A job of a few bytes: an arm of primitives in a cell with one crate, images of 8 x 6 pixels."""

from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

ARM_JOB = """\
[world]
model = "cell.glb"

[robot]
urdf = "arm.urdf"
base = { xyz = [1, 2, 3], rpy_deg = [0, 0, 90] }

[sensor]
link = "tool"
mount = { xyz = [0, 0, 0.1] }
model = "pinhole"
width = 8
height = 6
fx = 9.0
fy = 9.5
cx = 3.5
cy = 2.5
depth_unit = 0.001
range = [0.3, 4.0]
sigma = 0.01

[[frame]]
depth = "a.png"
mask = "mask.png"
joints = { shoulder = 0.1 }

[[frame]]
depth = "b.npy"
joints = { elbow = -0.2, lift = 0.05 }

[unknown.base]
position_sigma = 0.1
rotation_sigma_deg = [180, 90, 0]
"""

TRIPOD_JOB = """\
[world]
model = "cell.glb"

[sensor]
model = "spherical"
columns = 8
rows = 6
azimuth_deg = [-40, 40]
elevation_deg = [30, -30]
range = [0.3, 4.0]
sigma = [0.001, 0.0, 0.002]

[[frame]]
depth = "a.png"
pose = { xyz = [1, 2, 3] }
"""

_BOX = "<visual><geometry><box size='0.1 0.1 0.1'/></geometry></visual>"

_JOINT = """
<joint name="{name}" type="{kind}">
  <parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 0.2"/><axis xyz="0 0 1"/>
  <limit lower="-1" upper="1" effort="1" velocity="1"/>{more}
</joint>"""

_LINKS = ("foot", "upper", "fore", "finger", "thumb", "tool")

_JOINTS = (
    ("shoulder", "revolute", ""),
    ("elbow", "continuous", ""),
    ("lift", "prismatic", ""),
    ("twin", "revolute", "<mimic joint='shoulder' multiplier='2'/>"),
    ("flange", "fixed", ""),
)


def urdf() -> str:
    """A chain: shoulder, elbow, lift, twin (which follows shoulder) and a fixed flange."""
    links = "".join(f"<link name='{name}'>{_BOX}</link>" for name in _LINKS)
    joints = "".join(
        _JOINT.format(name=name, kind=kind, parent=_LINKS[i], child=_LINKS[i + 1], more=more)
        for i, (name, kind, more) in enumerate(_JOINTS)
    )
    return f"<robot name='arm'>{links}{joints}</robot>"


def write_files(folder: Path) -> None:
    """Everything that the jobs above name, and some images that do not fit."""
    (folder / "arm.urdf").write_text(urdf())
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box((1.0, 1.0, 1.0)), node_name="crate")
    scene.export(folder / "cell.glb")
    depth = np.full((6, 8), 1500, np.uint16)
    Image.fromarray(depth).save(folder / "a.png")
    np.save(folder / "b.npy", np.full((6, 8), 1.5, np.float32))
    mask = np.zeros((6, 8), np.uint8)
    mask[:3] = 255
    Image.fromarray(mask).save(folder / "mask.png")
    _write_misfits(folder)


def _write_misfits(folder: Path) -> None:
    Image.fromarray(np.full((5, 8), 1500, np.uint16)).save(folder / "short.png")
    Image.fromarray(np.full((6, 8), 15, np.uint8)).save(folder / "eight_bit.png")
    Image.fromarray(np.full((6, 8, 3), 15, np.uint8)).save(folder / "colour.png")
    Image.fromarray(np.zeros((6, 8), np.uint16)).save(folder / "empty.png")
    Image.fromarray(np.full((6, 8), 15000, np.uint16)).save(folder / "far.png")
    (folder / "broken.png").write_bytes((folder / "a.png").read_bytes()[:50])
    np.save(folder / "stack.npy", np.ones((2, 6, 8), np.float32))
    np.save(folder / "complex.npy", np.ones((6, 8), np.complex64))


def depth_with_upper_half_missing() -> Image.Image:
    """An image that was measured only where the mask is 0."""
    depth = np.full((6, 8), 1500, np.uint16)
    depth[:3] = 0
    return Image.fromarray(depth)


def write(folder: Path, text: str) -> Path:
    """Writes a job and everything that it names; the job file."""
    write_files(folder)
    file = folder / "job.toml"
    file.write_text(text)
    return file
