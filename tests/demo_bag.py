"""The recording of a demo's job as a bag: what a ROS driver of the same arm would have recorded."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
from bags import Messages, write_bag
from PIL import Image

PACKAGE = "arm"
DEPTH = "/camera/depth/image_rect_raw"
STAY, RATE = 2.0, 0.1
"""s at each posture, and from one joint state to the next."""


def bag_of(job: Path, kind: str, folder: Path) -> Path:
    """Writes a bag in which the job's robot goes from one of its postures to the next.

    Args:
        job: The file of a job with an arm and a pinhole.
        kind: One of ``bags.KINDS``.
        folder: Where the bag goes.
    """
    m, tables = Messages(kind), tomllib.loads(job.read_text())
    sensor, frames = tables["sensor"], tables["frame"]
    matrix = [sensor["fx"], 0, sensor["cx"], 0, sensor["fy"], sensor["cy"], 0, 0, 1]
    size = sensor["width"], sensor["height"]
    # Bags name meshes by their package.
    urdf = (job.parent / tables["robot"]["urdf"]).read_text()
    urdf = urdf.replace('filename="meshes/', f'filename="package://{PACKAGE}/meshes/')
    content: list[tuple[str, float, Any]] = [
        ("/robot_description", 0.0, m.text(urdf)),
        ("/camera/depth/camera_info", 0.0, m.camera(m.header(0.0, sensor["link"]), size, matrix)),
    ]
    for k, frame in enumerate(frames):
        for step in range(round(STAY / RATE)):
            time = STAY * k + RATE * step
            content.append(("/joint_states", time, m.joints(m.header(time), frame["joints"])))
        time = STAY * (k + 0.5)
        header = m.header(time, sensor["link"])
        pixels = _pixels(job.parent / frame["depth"])
        encoding = "16UC1" if pixels.dtype == np.uint16 else "32FC1"
        content.append((DEPTH, time, m.image(header, pixels, encoding)))
    return write_bag(folder, m, content)


def _pixels(file: Path) -> np.ndarray:
    return np.load(file) if file.suffix == ".npy" else np.array(Image.open(file))
