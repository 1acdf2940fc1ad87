"""Tracking with known truth: is a camera followed, are its sigmas honest, are alarms right?

A depth camera of 5 mm noise in the machine hall: it wanders without odometry, stands still, or is
carried along known poses; it may be bumped half way. Images are made by casting rays.
"""

import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro
from scipy.stats import chi2
from torch import Tensor

import torchcal
from torchcal import se3
from torchcal.demo import tracking_trials

WITHIN = float(chi2.ppf(0.997, 6))
"""Square of the Mahalanobis distance that 99.7 % of honest estimates do not exceed."""
START = (0.05, 2.0)
"""m, degrees: how far off the camera may be before the first frame, one standard deviation."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """One recording and its tracker."""

    what: tyro.conf.Positional[Literal["wandering", "standing", "carried"]]
    """2 cm and 2 degrees a frame, and nobody knows where to; not moving; along known poses."""
    frames: int = 200
    """How many."""
    views: int = 20
    """Different poses of a carried camera, visited back and forth."""
    bump: float = 0.0
    """m: how far the camera is moved half way."""
    width: int = 640
    """Pixels; the height is three quarters."""
    seed: int = 0
    """Of all draws."""
    json: Path | None = None
    """Where the results are written, beside the standard output."""


def pose_prior(position: float, degrees: float) -> torchcal.PosePrior:
    """The same sigma (m, degrees) on all axes."""
    sigmas = [position] * 3 + [math.radians(degrees)] * 3
    return torchcal.PosePrior(sigma=torch.tensor(sigmas, dtype=torch.float64))


def recording_of(options: Options) -> tuple[torchcal.Tracker, Any]:
    """The tracker before the first frame, and the frames with their truth."""
    draws = torch.Generator().manual_seed(options.seed)
    rng = np.random.default_rng(options.seed)
    sensor = tracking_trials.depth_camera(options.width)
    wanders = options.what == "wandering"
    views = {"wandering": options.frames, "standing": 1, "carried": options.views}[options.what]
    poses = tracking_trials.wandering(views, draws)
    offset = pose_prior(*START).sigma * torch.from_numpy(rng.standard_normal(6))
    error = poses[0] @ se3.exp(offset) @ se3.inverse(poses[0])
    job = tracking_trials.camera_job(sensor, error @ poses[0], pose_prior(*START))
    drift = torchcal.Wander(blocks={"base": pose_prior(0.02, 2.0)}) if wanders else None
    bump = None
    if options.bump > 0.0:
        direction = torch.randn(3, generator=draws, dtype=torch.float64)
        bump = se3.exp(torch.cat([options.bump * direction / direction.norm(), torch.zeros(3)]))
    known = None if wanders else error
    frames = tracking_trials.recording(poses, options.frames, sensor, rng, error=known, bump=bump)
    return torchcal.Tracker.of(job, drift=drift, generator=draws), frames


def compared(tracked: torchcal.Tracked, truth: Tensor) -> dict[str, Any]:
    """One frame against its truth."""
    error = se3.log(se3.inverse(tracked.T_world_sensor) @ truth)
    return {
        "status": tracked.status.value,
        "alarm": tracked.alarm,
        "position": float(error[:3].norm()),
        "rotation": float(error[3:].norm()),
        "distance": float(error @ torch.linalg.solve(tracked.pose_covariance, error)),
        "p_value": tracked.p_value,
        "agreement": tracked.agreement,
        "seconds": tracked.seconds,
    }


def summary(options: Options, frames: list[dict[str, Any]]) -> dict[str, Any]:
    """All frames together: metres and radians."""

    def column(key: str) -> np.ndarray:
        return np.array([frame[key] for frame in frames])

    half = (len(frames) + 1) // 2
    before, after = column("alarm")[:half], column("alarm")[half:]
    seconds = column("seconds")[1:]
    return {
        **{key: getattr(options, key) for key in ("what", "frames", "bump", "width", "seed")},
        "not_tracking": int((column("status") != "tracking").sum()),
        "alarms_before_half": int(before.sum()),
        "first_alarm_after_half": int(after.argmax()) + 1 if after.any() else None,
        "alarms_after_half": int(after.sum()),
        "within_99.7_percent_bound": float((column("distance") <= WITHIN).mean()),
        "nees": float(column("distance").mean()) / 6.0,
        "position_rms": float(np.sqrt((column("position") ** 2).mean())),
        "rotation_rms": float(np.sqrt((column("rotation") ** 2).mean())),
        "first_seconds": frames[0]["seconds"],
        "seconds_mean": float(seconds.mean()),
        "seconds_median": float(np.median(seconds)),
        "each": frames,
    }


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    if options.frames < 2 or options.views < 1 or options.width < 64:
        sys.exit("found too little; expected --frames of 2, --views of 1, --width of 64 at least")
    tracker, recording = recording_of(options)
    frames = []
    for number, (frame, truth) in enumerate(recording, start=1):
        tracker, tracked = tracker.step(frame)
        frames.append(compared(tracked, truth))
        last = frames[-1]
        words = f"{number:5} {last['status']:9} {'ALARM' if last['alarm'] else '     '}"
        words += f" {1e3 * last['position']:8.3f} mm {last['distance'] / 6:8.2f}"
        print(words + f" {last['seconds']:6.3f} s", file=sys.stderr, flush=True)
    text = json.dumps(summary(options, frames), indent=1) + "\n"
    sys.stdout.write(text)
    if options.json is not None:
        options.json.write_text(text)


if __name__ == "__main__":
    main()
