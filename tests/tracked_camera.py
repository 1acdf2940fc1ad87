"""A camera in the room for trackers: its job, its frames and how far an answer is off."""

from dataclasses import replace
from pathlib import Path

import recordings
import torch
from recordings import frame_of, pose, prior
from scipy.stats import chi2
from torch import Tensor

from torchcal.calibrate.tracked import Tracked
from torchcal.calibrate.tracker import Tracker
from torchcal.geometry import se3
from torchcal.model.job import Frame, Job

NEVER = float(chi2.isf(1e-6, 6))
"""Square of the Mahalanobis distance that honest estimates exceed once in a million."""
START = pose(0.1, 0.0, -0.6, 0.05, 0.1, 0.0)
SENSOR = recordings.sensor()


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def camera_job(nominal: Tensor = START, **changes) -> Job:
    """A job of a camera in the room that is believed to be at a pose; no frames."""
    job = Job(
        file=Path("job.toml"),
        world=recordings.world_of(recordings.room()),
        robot=None,
        sensor=SENSOR,
        link=None,
        T_world_base=nominal,
        T_link_sensor=recordings.EYE,
        frames=(),
        base=prior(),
        mount=None,
    )
    return replace(job, **changes)


def seen_from(truth: Tensor, seed: int = 0, nominal: Tensor | None = None) -> Frame:
    ranges = recordings.record(list(recordings.room().values()), truth, SENSOR, seed)
    return frame_of(ranges, T_world_sensor=nominal)


def followed(tracker: Tracker, frames: list[Frame]) -> tuple[Tracker, list[Tracked]]:
    taken = []
    for frame in frames:
        tracker, tracked = tracker.step(frame)
        taken.append(tracked)
    return tracker, taken


def distance(tracked: Tracked, truth: Tensor) -> float:
    """Square of the Mahalanobis distance of the pose from the true one."""
    error = se3.log(se3.inverse(tracked.T_world_sensor) @ truth)
    return float(error @ torch.linalg.solve(tracked.pose_covariance, error))
