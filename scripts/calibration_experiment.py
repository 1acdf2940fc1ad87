"""Everything that may be wrong, with known truth: are estimates right, and are their sigmas honest?

Truths are drawn from the job's prior, images are made by casting rays; the estimator has its own
renderer. Errors are compared with what the estimate claims and with the least that the same images
allow (Cramer-Rao).
"""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from scipy.stats import chi2
from torch import Tensor

import torchcal
from torchcal.demo import calibration_jobs, calibration_trials
from torchcal.demo.calibration_trials import Outcome


@dataclass(frozen=True, kw_only=True)
class Options:
    """Recordings of the demo's robots with one setting of unknowns."""

    what: tyro.conf.Positional[
        Literal[
            "joints",
            "everything",
            "objects",
            "sharp-objects",
            "range",
            "rover-laser",
            "rover-sonar",
        ]
    ]
    """Three joints of the arm; its base, joints and mount; two objects with the paper's sensor, or
    with 5 mm noise and beam 1; its base with a sensor that reads 1 % and 5 mm too far; the base of
    the rover with a preset."""
    trials: int = 10
    """Recordings to draw."""
    seed: int = 0
    """Of all draws."""
    side: int = 256
    """Pixels along a side of the arm's images."""
    json: Path | None = None
    """Where the results are written, beside the standard output."""


def run_trial(job: torchcal.Job, options: Options, number: int) -> dict[str, Any]:
    """One recording: what was found, against the truth."""
    known = calibration_jobs.not_drawn(options.what)
    trial = calibration_trials.draw_trial(job, options.seed, number, known=known)
    began = time.perf_counter()
    generator = torch.Generator().manual_seed(options.seed)
    calibration = torchcal.calibrate(trial.job, generator=generator)
    seconds = time.perf_counter() - began
    found = calibration_trials.outcome(trial, calibration)
    verdicts = calibration.update.verdicts
    return {
        "number": number,
        "status": found.status,
        "seconds": seconds,
        "error": found.error.tolist(),
        "sigma": found.covariance.diagonal().sqrt().tolist(),
        "least": found.least.diagonal().sqrt().tolist(),
        "nees": nees(found),
        "told": found.told.shape[1],
        "distance": found.distance,
        "within_997": bool(found.distance < chi2.ppf(0.997, found.told.shape[1])),
        "unobservable": [each.words for each in calibration.estimate.unobservable],
        "accused": [
            name
            for name, verdict in verdicts.items()
            if verdict.verdict.is_change and name not in job.objects
        ],
        "added": len(calibration.update.added),
    }


def nees(found: Outcome) -> float:
    """Per degree of freedom."""
    error = found.error
    return float(error @ torch.linalg.solve(found.covariance, error)) / max(1, len(error))


def block_summary(trials: list[dict[str, Any]], rows: list[int]) -> dict[str, float]:
    """Of parameters that belong together."""

    def column(key: str) -> Tensor:
        return torch.tensor([[trial[key][i] for i in rows] for trial in trials])

    z = (column("error") / column("sigma")).abs()
    return {
        "rms": float(column("error").square().mean().sqrt()),
        "largest": float(column("error").abs().max()),
        "claimed_rms": float(column("sigma").square().mean().sqrt()),
        "cramer_rao_rms": float(column("least").square().mean().sqrt()),
        "within_3_sigma": float((z <= 3.0).double().mean()),
        "largest_z": float(z.max()),
    }


def summary(
    options: Options, names: tuple[str, ...], trials: list[dict[str, Any]]
) -> dict[str, Any]:
    """All trials together: metres and radians."""
    statuses = [trial["status"] for trial in trials]
    blocks: dict[str, list[int]] = {}
    for place, name in enumerate(names):
        blocks.setdefault(block_of(name), []).append(place)
    return {
        **{key: getattr(options, key) for key in ("what", "trials", "seed", "side")},
        "status": {status: statuses.count(status) for status in sorted(set(statuses))},
        "nees_mean": sum(trial["nees"] for trial in trials) / len(trials),
        "within_997": sum(trial["within_997"] for trial in trials) / len(trials),
        "accused": sum(bool(trial["accused"]) for trial in trials),
        "added": sum(trial["added"] for trial in trials),
        "seconds_mean": sum(trial["seconds"] for trial in trials) / len(trials),
        "blocks": {block: block_summary(trials, rows) for block, rows in blocks.items()},
        "names": names,
        "each": trials,
    }


def block_of(name: str) -> str:
    """The part of a parameter's name that it shares with others of the same unit."""
    first, _, axis = name.rpartition(".")
    if first == "joints":
        return first
    if first == "range":
        return name
    return f"{first} {'turn' if axis.startswith('r') else 'shift'}"


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    if options.trials < 1 or options.side < 32:
        sys.exit(f"--trials {options.trials} --side {options.side}: at least 1 and 32")
    if options.json is not None and not options.json.absolute().parent.is_dir():
        sys.exit(f"--json {options.json}: not a file in a folder that is there")
    job = calibration_jobs.job_of(options.what, options.side)
    names = torchcal.Parameters.of(job, torchcal.build_job_scene(job)).names
    trials = []
    for number in range(options.trials):
        trials.append(run_trial(job, options, number))
        last = trials[-1]
        words = f"{number:4} {last['status']:12} NEES {last['nees']:6.2f} {last['seconds']:6.1f} s"
        print(words, file=sys.stderr, flush=True)
    text = json.dumps(summary(options, names, trials), indent=1) + "\n"
    sys.stdout.write(text)
    if options.json is not None:
        options.json.write_text(text)


if __name__ == "__main__":
    main()
