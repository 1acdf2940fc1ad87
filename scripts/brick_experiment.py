"""The experiment of 4.1: the pose of a brick from vertexes with half-wrong correspondences.

Draws trials, estimates every pose and compares with the truth, with what can be known from the
correspondences (oracle) and from the noise (Cramer-Rao), and with the paper.
"""

import json
import os
import resource
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import torch
import tyro

import torchcal
from torchcal.demo import brick

PAPER = {
    "success": 0.973,
    "position_rms_m": 0.010,
    "rotation_rms_rad": 0.012,
    "iterations_mean": 50.5,
    "searches_mean": 1.8,
}
"""Of 4.1, with 1000 trials."""


@dataclass(frozen=True, kw_only=True)
class Options:
    """The experiment of 4.1 on random bricks."""

    trials: int = 1000
    """Bricks to draw."""
    protocol: brick.Protocol = "all-pairs"
    """Which correspondences a trial is given."""
    seed: int = 0
    """Of all draws."""
    restarts: int = 4
    """Most repetitions of the search where good estimation cannot be obtained."""
    device: str = "cpu"
    """Where the trials are solved."""
    json: Path | None = None
    """Where the results are written, beside the standard output."""


def solve(
    trials: brick.BrickTrials, options: Options, least_cutoff: float
) -> torchcal.ElementPoses:
    detect = (
        torchcal.nearest_candidate if options.protocol == "nearest" else torchcal.every_candidate
    )
    return torchcal.find_element_poses(
        brick.brick_model().to(options.device),
        trials.measured.to(options.device),
        trials.candidates.to(options.device),
        generator=torch.Generator().manual_seed(options.seed),
        # All eight vertexes are there, so a good pose explains all eight.
        search=torchcal.ElementSearch(
            enough=1.0, restarts=options.restarts, least_cutoff=least_cutoff
        ),
        detect=detect,
    )


def shares(trial: torch.Tensor, is_right: torch.Tensor, trials: int) -> torch.Tensor:
    """For every trial the share of right poses among its tied ones; 0 without any."""
    total = torch.zeros(trials, dtype=torch.float64)
    right = total.index_add(0, trial, is_right.double())
    return right / total.index_add(0, trial, torch.ones_like(is_right.double())).clamp(min=1.0)


def from_candidates(poses: torchcal.ElementPoses, truth: torch.Tensor) -> dict[str, float]:
    """Rates before the correspondences are detected again among all pairs."""
    tied = poses.from_candidates
    batch, T = tied.batch.cpu(), tied.T.cpu()
    success = brick.are_successes(brick.errors(T, truth[batch]))
    return {
        "success_modulo_symmetry_from_candidates": float(
            shares(batch, success.any(-1), len(truth)).mean()
        ),
        "success_absolute_from_candidates": float(shares(batch, success[:, 0], len(truth)).mean()),
    }


def absolute(poses: torchcal.ElementPoses, truth: torch.Tensor) -> float:
    """Rate of the true pose itself; k symmetric poses with equal support count 1/k."""
    equal = poses.rivals_supported == poses.supported[poses.rivals.batch]
    rivals = poses.rivals[equal.nonzero()[:, 0]]
    batch = torch.cat([torch.arange(len(truth)), rivals.batch.cpu()])
    T = torch.cat([poses.T_measured_model.cpu(), rivals.T.cpu()])
    success = brick.are_successes(brick.errors(T, truth[batch]))[:, 0]
    return float(shares(batch, success, len(truth)).mean())


def accuracy(poses: torchcal.ElementPoses, truth: torch.Tensor) -> dict[str, float]:
    """Rate, errors and consistency modulo symmetry, of the successes."""
    twists = brick.errors(poses.T_measured_model.cpu(), truth)
    success = brick.are_successes(twists)
    kept = success.any(-1)
    known = poses.covariance.cpu().isfinite().flatten(1).all(-1)
    xi = twists[kept, success[kept].double().argmax(-1)]
    told = known[kept]
    normalised = torch.linalg.solve(poses.covariance.cpu()[kept & known], xi[told])
    return {
        "success_modulo_symmetry": float(kept.double().mean()),
        "position_rms_m": float(xi[:, :3].square().sum(-1).mean().sqrt()),
        "rotation_rms_rad": float(xi[:, 3:].square().sum(-1).mean().sqrt()),
        "nees_mean": float((xi[told] * normalised).sum(-1).mean() / 6),
        "with_covariance": float(told.double().mean()),
    }


def peak_memory_mb(device: str) -> float:
    if torch.device(device).type == "cuda":
        return torch.cuda.max_memory_allocated() / 2**20
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10


def run(options: Options) -> dict[str, object]:
    generator = torch.Generator().manual_seed(options.seed)
    trials = brick.draw_trials(options.trials, options.protocol, generator=generator)
    truth = trials.T_measured_brick
    began = time.perf_counter()
    poses = solve(trials, options, torchcal.ElementSearch().least_cutoff)
    poses.status.tolist()  # waits for the device
    seconds = time.perf_counter() - began
    memory = peak_memory_mb(options.device)
    known = brick.oracle(trials.candidates)
    least = brick.cramer_rao().diagonal()
    literal = accuracy(solve(trials, options, 0.0), truth)
    return {
        "trials": options.trials,
        "protocol": options.protocol,
        "seed": options.seed,
        "restarts": options.restarts,
        "device": options.device,
        **accuracy(poses, truth),
        "success_absolute": absolute(poses, truth),
        **from_candidates(poses, truth),
        "oracle_modulo_symmetry": float(known.modulo_symmetry.mean()),
        "oracle_absolute": float(known.absolute.mean()),
        "cramer_rao_position_m": float(least[:3].sum().sqrt()),
        "cramer_rao_rotation_rad": float(least[3:].sum().sqrt()),
        "iterations_mean": float(poses.iterations.double().mean()),
        "searches_mean": float(poses.searches.double().mean()),
        "seconds": seconds,
        "peak_memory_mb": memory,
        "literal_eq_16": literal,
        "paper": PAPER,
    }


def mistake(options: Options) -> str | None:
    """What is wrong with the options, before anything is computed."""
    if options.trials < 1 or options.restarts < 0:
        return f"--trials {options.trials} --restarts {options.restarts}: at least 1 and 0"
    try:
        torch.zeros(1, device=options.device)
    except (RuntimeError, AssertionError) as error:
        return f"--device {options.device}: {str(error).splitlines()[0]}"
    file = options.json
    if file is not None and (file.is_dir() or not os.access(file.absolute().parent, os.W_OK)):
        return f"--json {file}: not a file in a folder that can be written to"
    return None


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    wrong = mistake(options)
    if wrong is not None:
        sys.exit(wrong)
    text = json.dumps(run(options), indent=2) + "\n"
    sys.stdout.write(text)
    if options.json is not None:
        options.json.write_text(text)


if __name__ == "__main__":
    main()
