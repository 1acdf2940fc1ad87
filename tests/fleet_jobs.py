"""Tiny jobs in files whose answers are known: a camera before a wall with a crate beside it."""

import os
from pathlib import Path

import numpy as np
import trimesh

WIDTH, HEIGHT = 12, 9
WALL = 2.0
"""m"""

JOB = """\
[world]
model = "cell.glb"

[sensor]
model = "pinhole"
width = 12
height = 9
fx = 12.0
fy = 12.0
cx = 5.5
cy = 4.0
range = [0.3, 5.0]
sigma = 0.01
drift = 0

[[frame]]
depth = "0001.npy"
pose = { xyz = [0, 0, 0] }
"""

UNKNOWN = """
[unknown.base]
position_sigma = [0, 0, 0.05]
rotation_sigma_deg = 0
"""


def write_job(folder: Path, *, wall: float = WALL, text: str = JOB) -> Path:
    """A job whose image shows a wall at some distance (m); the model's is at 2 m. The job file."""
    folder.mkdir(parents=True)
    scene = trimesh.Scene()
    scene.add_geometry(
        trimesh.creation.box((20.0, 20.0, 1.0)).apply_translation((0.0, 0.0, WALL + 0.5)),
        node_name="wall",
    )
    scene.export(folder / "cell.glb")
    noise = 0.01 * np.random.default_rng(0).standard_normal((HEIGHT, WIDTH))
    np.save(folder / "0001.npy", np.float32(wall + noise))
    file = folder / "job.toml"
    file.write_text(text, encoding="utf-8")
    return file


def spoil(job: Path) -> None:
    """Makes a job that cannot be read."""
    job.write_text("[sensor]\nmodel = 'glass eye'\n", encoding="utf-8")


def date(job: Path, seconds: float) -> None:
    """Sets the time at which the job's image was written (s since 1970)."""
    os.utime(job.parent / "0001.npy", (seconds, seconds))
