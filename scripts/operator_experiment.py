"""What an operator is shown and told, against the truth: false alarms, verdicts, new objects.

A storeroom of crates, three images from different sides, the sensor 0.1 m and 5 degrees from where
the job says. Images are made by casting rays; the comparison has its own renderer.
"""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import tyro

import torchcal
from torchcal.calibrate.update import frame_regions
from torchcal.demo import operator_trials
from torchcal.demo.operator_trials import OperatorTrial

ALPHAS = (2.0, 3.0, 4.0)
CHANGES = {"clean": (), "nominal": ("removed",), "changed": ("removed", "moved", "added")}


@dataclass(frozen=True, kw_only=True)
class Options:
    """Recordings of the storeroom."""

    what: tyro.conf.Positional[Literal["clean", "nominal", "changed"]]
    """As modelled; one crate gone and nothing estimated; one gone, one pushed by 10 cm, one new."""
    sensor: Literal["camera", "paper"] = "camera"
    """5 mm of noise and pixels of their own; or 5 cm and the wide beam of the paper's 4.2."""
    trials: int = 20
    """Recordings to draw."""
    frames: int = 3
    """Images of each."""
    side: int = 128
    """Pixels along a side of the images."""
    seed: int = 0
    """Of all draws."""
    json: Path | None = None
    """Where the results are written, beside the standard output."""


def run_trial(options: Options, number: int) -> dict[str, Any]:
    """One recording: what was said of it, against the truth."""
    camera = operator_trials.depth_camera
    sensor = (camera if options.sensor == "camera" else operator_trials.paper_sensor)(options.side)
    trial = operator_trials.draw_trial(
        sensor, options.seed, number, frames=options.frames, changes=CHANGES[options.what]
    )
    began = time.perf_counter()
    calibration = torchcal.calibrate(
        trial.job,
        estimate=options.what != "nominal",
        generator=torch.Generator().manual_seed(options.seed),
    )
    seconds = time.perf_counter() - began
    return {
        "number": number,
        "seconds": seconds,
        "status": calibration.estimate.status.value,
        "regions": regions_of(calibration),
        **outside(trial, calibration),
        **judged(trial, calibration.update),
    }


def regions_of(calibration: torchcal.Calibration) -> int:
    """Regions that differ from the model, in all frames."""
    pixels = calibration.estimate.drift_pixels
    found = frame_regions(calibration.job, calibration.comparisons, correlation_pixels=pixels)
    return sum(len(each) for each in found)


def outside(trial: OperatorTrial, calibration: torchcal.Calibration) -> dict[str, Any]:
    """Shares of the compared pixels of unchanged objects that eq. 1 and eq. 5 flag."""
    world = trial.job.world
    assert world is not None, "the storeroom has a world"
    gone = [k for k, item in enumerate(world.objects) if item.name == trial.changes.removed]
    by_eq1, by_eq5 = [], []
    for frame in calibration.comparisons:
        difference = frame.measured - frame.predicted
        kept = difference.isfinite() & ~torch.isin(frame.body, torch.tensor(gone))
        sigma = trial.job.sensor.noise.sigma(frame.predicted)
        by_eq1.append((difference / sigma)[kept].abs())
        by_eq5.append((difference / frame.sigma)[kept].abs())
    d1, d5 = torch.cat(by_eq1), torch.cat(by_eq5)
    return {
        "pixels": len(d5),
        "eq1": [int((d1 > alpha).sum()) for alpha in ALPHAS],
        "eq5": [int((d5 > alpha).sum()) for alpha in ALPHAS],
    }


def judged(trial: OperatorTrial, update: torchcal.Update) -> dict[str, Any]:
    """Which verdicts are right, who is accused without reason, and how well new things fit."""
    truth, verdicts = trial.changes, update.verdicts
    expected = {truth.removed: "removed", truth.moved: "moved"}
    accused = [
        name for name, each in verdicts.items() if each.verdict.is_change and name not in expected
    ]
    right = {
        verdict: verdicts[name].verdict == verdict
        for name, verdict in expected.items()
        if name is not None
    }
    return {
        **right,
        "accused": accused,
        "added": len(update.added),
        "overlap": overlaps(trial, update),
        "moved_off": moved_off(trial, update),
    }


def overlaps(trial: OperatorTrial, update: torchcal.Update) -> list[float]:
    """Intersection over union of each added object's box with what was seen of the true one."""
    points = trial.seen_of_added
    if not len(points):
        return []
    box = np.stack([points.min(0), points.max(0)])
    return [operator_trials.box_overlap(item.mesh.bounds, box) for item in update.added]


def moved_off(trial: OperatorTrial, update: torchcal.Update) -> float | None:
    """How far (m) the moved object's new place is from the true one; None where it has none."""
    name, T = trial.changes.moved, trial.changes.T_world_moved
    found = None if name is None else update.verdicts[name].T_world_object
    if T is None or found is None:
        return None
    return float(np.linalg.norm(found.numpy()[:3, 3] - T[:3, 3]))


def is_right(options: Options, trial: dict[str, Any]) -> bool:
    """Whether nothing is said that is not so, and everything that is."""
    if trial["accused"] or not all(trial.get(key, True) for key in ("removed", "moved")):
        return False
    if options.what == "changed":
        return trial["added"] == 1 and trial["overlap"][0] > 0.0
    return trial["added"] == 0 if options.what == "clean" else True


def summary(options: Options, trials: list[dict[str, Any]]) -> dict[str, Any]:
    """All trials together."""
    pixels = sum(trial["pixels"] for trial in trials)
    best = [max(trial["overlap"], default=0.0) for trial in trials]
    return {
        **{key: getattr(options, key) for key in ("what", "sensor", "trials", "frames", "side")},
        "right": sum(is_right(options, trial) for trial in trials),
        "without_region": sum(trial["regions"] == 0 for trial in trials),
        "accused": sum(bool(trial["accused"]) for trial in trials),
        "eq1_percent": share([trial["eq1"] for trial in trials], pixels),
        "eq5_percent": share([trial["eq5"] for trial in trials], pixels),
        "worst_overlap": min(best),
        "seconds_mean": sum(trial["seconds"] for trial in trials) / len(trials),
        "each": trials,
    }


def share(counts: list[list[int]], pixels: int) -> dict[str, float]:
    """Percent of the pixels for each alpha."""
    total = np.sum(counts, axis=0)
    return {f"{a:g}": 100.0 * float(n) / pixels for a, n in zip(ALPHAS, total, strict=True)}


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    if options.trials < 1 or options.frames < 1 or options.side < 32:
        sys.exit("found too little; expected --trials and --frames of 1, --side of 32 at least")
    if options.json is not None and not options.json.absolute().parent.is_dir():
        sys.exit(f"--json {options.json}: not a file in a folder that is there")
    trials = []
    for number in range(options.trials):
        trials.append(run_trial(options, number))
        last = trials[-1]
        word = "right" if is_right(options, last) else "WRONG"
        print(f"{number:4} {word} {last}", file=sys.stderr, flush=True)
    text = json.dumps(summary(options, trials), indent=1) + "\n"
    sys.stdout.write(text)
    if options.json is not None:
        options.json.write_text(text)


if __name__ == "__main__":
    main()
