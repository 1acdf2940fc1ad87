"""``torchcal follow``: a line for each frame, and at the end what became of the calibration."""

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from rich.console import Console

from torchcal.calibrate.follow import follow
from torchcal.calibrate.tracked import Tracked, TrackStatus
from torchcal.calibrate.wander import Wander
from torchcal.cli.commands import NOT_USABLE, USABLE, device, generator, line
from torchcal.cli.console import write
from torchcal.cli.options import Follow
from torchcal.cli.output import FRAMES, input_files, replaced_folder
from torchcal.cli.progress import progress
from torchcal.cli.result_files import as_json, without_nan
from torchcal.errors import TorchcalError
from torchcal.model.job import Job, PosePrior
from torchcal.model.read_job import read_recording

NOT_EXPLAINED = (TrackStatus.LOST, TrackStatus.UNUSABLE)


def run_follow(command: Follow, out: Console, err: Console) -> int:
    """``torchcal follow``; returns the exit status."""
    recording = read_recording(command.job, device=device(command.options))
    drift = drift_of(command, recording.job)
    steps = follow(recording, drift=drift, generator=generator(command.options))
    taken: list[Tracked] = []
    with replaced_folder(command.out, input_files(command.job)) as folder:
        with progress(err) as report, (folder / FRAMES).open("w", encoding="utf-8") as file:
            for tracked in steps:
                taken.append(tracked)
                text = json.dumps(frame_dict(tracked), allow_nan=False, ensure_ascii=False) + "\n"
                file.write(text)
                file.flush()
                if command.options.json:
                    write(out, text)
                report("follow", len(taken) / len(recording.files))
        text = as_json(summary_dict(taken))
        (folder / "result.json").write_text(text + "\n", encoding="utf-8")
    if not command.options.json:
        _tell(taken, command.out, out)
    if all(each.status in NOT_EXPLAINED for each in taken):
        words = f"no frame was explained: torchcal check {command.job} names mistakes that it finds"
        line(err, words)
    last = taken[-1]
    return USABLE if last.status == TrackStatus.TRACKING and not last.alarm else NOT_USABLE


def drift_of(command: Follow, job: Job) -> Wander:
    """The drift that a person asked for.

    Raises:
        TorchcalError: If only one of both numbers is given or one is negative, or there is no
            unknown base to move.
    """
    given = {"--shift": command.shift, "--turn-deg": command.turn_deg}
    numbers = [value for value in given.values() if value is not None]
    if not numbers:
        return Wander()
    if len(numbers) < len(given) or not all(math.isfinite(n) and n >= 0.0 for n in numbers):
        found = ", ".join(f"{option} {value}" for option, value in given.items())
        raise TorchcalError(f"found {found}; expected both, 0 or more")
    if job.base is None:
        raise TorchcalError("--shift: found no unknown.base in the job; expected one that may move")
    shift, turn = numbers
    sigma = torch.tensor([shift] * 3 + [math.radians(turn)] * 3, dtype=torch.float64)
    return Wander(blocks={"base": PosePrior(sigma=sigma)})


def frame_dict(tracked: Tracked) -> dict[str, Any]:
    """One line of ``frames.jsonl``: metres and radians; no NaN (None instead)."""
    sigmas = tracked.pose_covariance.diagonal().clamp(min=0.0).sqrt().tolist()
    own = tracked.covariance.diagonal().clamp(min=0.0).sqrt().tolist()
    corrections = zip(tracked.names, tracked.corrections.tolist(), own, strict=True)
    return without_nan(
        {
            "name": tracked.name,
            "status": tracked.status.value,
            "alarm": tracked.alarm,
            "message": tracked.message,
            "p_value": tracked.p_value,
            "agreement": tracked.agreement,
            "T_world_sensor": tracked.T_world_sensor.tolist(),
            "position_sigma_m": sigmas[:3],
            "rotation_sigma_rad": sigmas[3:],
            "corrections": {
                name: {"value": value, "sigma": sigma} for name, value, sigma in corrections
            },
            "seconds": tracked.seconds,
            "covariance": tracked.covariance.tolist(),
        }
    )


def summary_dict(taken: Sequence[Tracked]) -> dict[str, Any]:
    """``result.json``: what the frames were, which ones raised an alarm, and the last one whole."""
    last = taken[-1]
    return without_nan(
        {
            "status": last.status.value,
            "message": last.message,
            "frames": {
                status.value: sum(each.status == status for each in taken) for status in TrackStatus
            },
            "alarms": [
                {"name": each.name, "message": each.message} for each in taken if each.alarm
            ],
            "last": frame_dict(last),
            "names": list(last.names),
            "covariance": last.covariance.tolist(),
        }
    )


def _tell(taken: Sequence[Tracked], folder: Path, out: Console) -> None:
    counts = [
        f"{count} {status.value}"
        for status in TrackStatus
        if (count := sum(each.status == status for each in taken))
    ]
    line(out, f"{len(taken)} frames: {', '.join(counts)}")
    for each in taken:
        if each.alarm or each.status != TrackStatus.TRACKING:
            line(out, f"{'ALARM ' if each.alarm else ''}{each.name}: {each.message}")
    tracking = [each for each in taken if each.status == TrackStatus.TRACKING]
    if tracking:
        worst = min(tracking, key=lambda each: each.agreement)
        line(
            out,
            f"The model agrees with {100.0 * worst.agreement:.1f} % of what was measured in frame "
            f"{worst.name}, the least of those tracking; torchcal calibrate says what differs",
        )
    line(out, f"Every frame is in {folder / FRAMES}")
