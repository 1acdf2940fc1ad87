"""A bag of a tiny arm with a camera on its tool, and importing it."""

from pathlib import Path
from typing import Any

import numpy as np
import tiny_job
from bags import Messages, write_bag

from torchcal.model.recordings.import_recording import Imported, import_recording

WIDTH, HEIGHT = 8, 6
MATRIX = (9.0, 0.0, 3.5, 0.0, 9.5, 2.5, 0.0, 0.0, 1.0)
DEPTH, INFO, JOINTS = "/camera/depth/image_rect_raw", "/camera/depth/camera_info", "/joint_states"
FRAME = "depth_optical_frame"
POSTURES = (0.1, 0.1, -0.4, 0.7)
"""Of the shoulder (rad), two seconds each; the first two are one."""
SWING = 0.4
"""s from one posture to the next."""


def depth(k: int) -> np.ndarray:
    """An image that tells its number: mm."""
    image = np.full((HEIGHT, WIDTH), 1000 + k, np.uint16)
    image[0, 0] = 0
    return image


def shoulder(time: float) -> float:
    """rad: the posture of these two seconds, to which it swings at their beginning."""
    k = min(int(time // 2.0), len(POSTURES) - 1)
    before = POSTURES[max(k - 1, 0)]
    share = min((time - 2.0 * k) / SWING, 1.0)
    return before + share * (POSTURES[k] - before)


def arm(messages: Messages, *, without: tuple[str, ...] = (), clock: float = 0.0) -> list:
    """An arm with a camera on its tool, recorded for eight seconds."""
    m = messages
    flange = m.transform(m.header(0.0, "tool"), "camera_link", (0.0, 0.0, 0.1))
    lens = m.transform(
        m.header(0.0, "camera_link"), FRAME, (0.02, 0.0, 0.0), (-0.5, 0.5, -0.5, 0.5)
    )
    content: list[tuple[str, float, Any]] = [
        ("/robot_description", 0.0, m.text(tiny_job.urdf())),
        ("/tf_static", 0.0, m.transforms(flange, lens)),
        (INFO, 0.0, m.camera(m.header(0.0, FRAME), (WIDTH, HEIGHT), MATRIX)),
    ]
    for k in range(80):
        time = 0.1 * k
        names = {"shoulder": shoulder(time), "elbow": -0.2}
        content.append((JOINTS, time + 0.001, m.joints(m.header(time), names)))
    for k in range(16):
        time = 0.5 * k + 0.03
        image = m.image(m.header(time, FRAME, clock), depth(k), "16UC1")
        content.append((DEPTH, time + 0.02, image))
    return [each for each in content if each[0] not in without]


def imported(tmp_path: Path, content: list, messages: Messages, **more: Any) -> Imported:
    source = write_bag(tmp_path, messages, content)
    (tmp_path / "out").mkdir()
    return import_recording(source, tmp_path / "out", **more)
