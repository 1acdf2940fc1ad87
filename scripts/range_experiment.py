"""The experiment of 4.2: the pose of a sensor from one range image of a cell.

Images of 512 x 512 pixels over 50 degrees, with N = 10 and a noise of 5 cm, are made by casting
rays; the estimator has its own renderer. Its poses are compared with the truth, with the least
errors that the same images allow (Cramer-Rao), and with the paper.
"""

import json
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
import tyro
from torch import Tensor

import torchcal
from torchcal import edges_figure, se3
from torchcal.demo import range_trials
from torchcal.demo.machine_hall import machine_hall
from torchcal.demo.match_score import Truth, right_matches

FOUND = 0.1
"""m and rad within which a pose counts as found."""
PAPER = {
    "position_rms_m": 0.030,
    "rotation_rms_rad": 0.034,
    "lines": 36,
    "candidates": 21,
    "right": 7,
}
"""Of 4.2, from 0.1 m and 5 degrees off, by lines alone."""
STAGES = ("elements", "pixels")


@dataclass(frozen=True, kw_only=True)
class Options:
    """The experiment of 4.2 in a machine hall."""

    trials: int = 20
    """Images to draw."""
    seed: int = 0
    """Of all draws."""
    initial: str = "0.1,5"
    """How far off the starting value is: metres,degrees, or none."""
    stage: Literal["elements", "pixels"] = "pixels"
    """Whose poses are counted as found, and drawn."""
    cast: int = 0
    """Trials whose Cramer-Rao values are worked out by casting rays, too; a minute each."""
    json: Path | None = None
    """Where the results are written, beside the standard output."""
    picture: Path | None = None
    """Where figure 3 goes: lines and estimated model over the first image."""


@dataclass(frozen=True, kw_only=True)
class Setting:
    """What all trials have in common."""

    options: Options
    sensor: torchcal.Sensor
    world: torchcal.World
    site: torchcal.Site

    @staticmethod
    def of(options: Options) -> "Setting":
        """The hall and the sensor."""
        world = machine_hall()
        scene = torchcal.build_scene(world, None, dtype=torch.float64, device=torch.device("cpu"))
        origin = torch.eye(4, dtype=torch.float64)
        bodies = torchcal.body_poses(scene, world, None, origin, None)
        draws = torch.Generator().manual_seed(options.seed)
        site = torchcal.Site.of(scene.surface, bodies, draws)
        sensor = range_trials.range_sensor()
        return Setting(options=options, sensor=sensor, world=world, site=site)


def offset(initial: str) -> tuple[float, float] | None:
    """Metres and radians of --initial."""
    if initial == "none":
        return None
    metres, degrees = (float(part) for part in initial.split(","))
    if not (metres > 0.0 and degrees > 0.0):
        raise ValueError(initial)
    return metres, math.radians(degrees)


def prior(start: Tensor, off: tuple[float, float]) -> torchcal.Prior:
    """As wide as what the starting value is off by."""
    variances = [part**2 / 3.0 for part in off for _ in range(3)]
    return torchcal.Prior(
        T_world_sensor=start, covariance=torch.tensor(variances, dtype=torch.float64).diag()
    )


def cramer_rao(setting: Setting, T_world_sensor: Tensor) -> Tensor:
    """From the derivative of the predicted image at the true pose."""
    site, sensor = setting.site, setting.sensor
    poses = (se3.inverse(T_world_sensor) @ site.Ts_world_body).float()
    motion = -torch.eye(6).expand(len(poses), 6, 6)
    view = torchcal.synthesise(site.surface, poses, sensor, motion)
    assert view.jacobian is not None
    met = view.range.isfinite()
    A = (view.jacobian[met] / sensor.noise.sigma(view.range[met])[:, None]).double()
    return torch.linalg.inv(A.mT @ A)


def errors(pose: torchcal.StagePose | None, truth: Tensor) -> dict[str, Any]:
    """Of one stage in one trial."""
    if pose is None:
        return {"found": False}
    position, rotation = range_trials.errors(pose.T_world_sensor, truth)
    xi = se3.log(se3.inverse(truth) @ pose.T_world_sensor)
    return {
        "found": float(position) < FOUND and float(rotation) < FOUND,
        "position_m": float(position),
        "rotation_rad": float(rotation),
        "nees": float(xi @ torch.linalg.solve(pose.covariance, xi)) / 6.0,
    }


def run_trial(setting: Setting, number: int) -> dict[str, Any]:
    """One image: what was found, against the truth."""
    options, off = setting.options, offset(setting.options.initial)
    trial = range_trials.draw_trial(
        options.seed, number, offset=off, sensor=setting.sensor, world=setting.world
    )
    start = None
    if off is not None and trial.start is not None:
        start = prior(trial.start, off)
    began, busy = time.perf_counter(), time.process_time()
    found = torchcal.localise(
        trial.range,
        setting.site,
        setting.sensor,
        start=start,
        generator=torch.Generator().manual_seed(options.seed),
    )
    seconds, cpu_seconds = time.perf_counter() - began, time.process_time() - busy
    if number == 0 and options.picture is not None:
        draw(setting, trial, found, options.picture)
    least = cramer_rao(setting, trial.T_world_sensor)
    return {
        "number": number,
        "status": str(found.status),
        "elements": errors(found.elements, trial.T_world_sensor),
        "pixels": errors(found.pixels, trial.T_world_sensor),
        "agreement": found.agreement,
        **counts(setting, found, trial.T_world_sensor),
        "cramer_rao": variances(least),
        "cramer_rao_cast": variances(
            range_trials.cramer_rao(trial.T_world_sensor, world=setting.world)
        )
        if number < options.cast
        else None,
        "seconds": seconds,
        "cpu_seconds": cpu_seconds,
        "stages": found.seconds,
    }


def counts(setting: Setting, found: torchcal.Localisation, truth: Tensor) -> dict[str, int]:
    """Elements and matches of one trial; the paper counts lines."""
    if (matches := found.matches) is None:
        return {}
    shown = Truth.of(range_trials.meshes_in_world(setting.world), truth, setting.sensor.projection)
    right = torch.from_numpy(right_matches(matches.model, matches.measured, matches.pairs, shown))
    planes = matches.measured.planes.elements.count
    lines = len(matches.measured.lines.kind)
    own = matches.pairs[:, 1]
    is_line = (own >= planes) & (own < planes + lines)
    return {
        "lines": lines,
        "planes": planes,
        "vertices": matches.measured.vertices.elements.count,
        "line_candidates": int(is_line.sum()),
        "line_candidates_right": int((is_line & right).sum()),
        "kept": int(matches.used.sum()),
        "kept_right": int((matches.used & right).sum()),
    }


def variances(P: Tensor) -> list[float]:
    """Of position and rotation, summed over the axes."""
    return [float(P.diagonal()[:3].sum()), float(P.diagonal()[3:].sum())]


def stage_summary(trials: list[dict[str, Any]], stage: str) -> dict[str, float]:
    """Rates and errors of one stage."""
    found = [trial for trial in trials if trial[stage]["found"]]
    summary = {"found": len(found) / len(trials)}
    if found:
        of = {
            key: torch.tensor([trial[stage][key] for trial in found], dtype=torch.float64)
            for key in ("position_m", "rotation_rad", "nees")
        }
        least = torch.tensor([trial["cramer_rao"] for trial in found]).mean(0).sqrt()
        summary |= {
            "position_rms_m": float(of["position_m"].square().mean().sqrt()),
            "rotation_rms_rad": float(of["rotation_rad"].square().mean().sqrt()),
            "position_median_m": float(of["position_m"].median()),
            "rotation_median_rad": float(of["rotation_rad"].median()),
            "within_10_mm_5_mrad": sum(
                trial[stage]["position_m"] < 0.010 and trial[stage]["rotation_rad"] < 0.005
                for trial in found
            )
            / len(trials),
            "nees_mean": float(of["nees"].mean()),
            "cramer_rao_position_m": float(least[0]),
            "cramer_rao_rotation_rad": float(least[1]),
        }
    return summary


def summary(options: Options, trials: list[dict[str, Any]]) -> dict[str, Any]:
    """All trials together."""

    def mean(key: str) -> float:
        values = [trial[key] for trial in trials if key in trial]
        return sum(values) / max(1, len(values))

    kept = sum(trial.get("kept", 0) for trial in trials)
    statuses = [trial["status"] for trial in trials]
    converged = [trial for trial in trials if trial["status"] == "converged"]
    return {
        **{key: getattr(options, key) for key in ("trials", "seed", "initial", "stage")},
        "success": sum(trial[options.stage]["found"] for trial in trials) / len(trials),
        "status": {status: statuses.count(status) for status in sorted(set(statuses))},
        "false_converged": sum(not trial["pixels"]["found"] for trial in converged),
        **{stage: stage_summary(trials, stage) for stage in STAGES},
        **{
            f"{key}_mean": mean(key)
            for key in (
                "lines",
                "planes",
                "vertices",
                "line_candidates",
                "line_candidates_right",
                "kept",
                "seconds",
                "cpu_seconds",
            )
        },
        "kept_right_share": sum(trial.get("kept_right", 0) for trial in trials) / max(1, kept),
        "paper": PAPER,
        "each": trials,
    }


def draw(
    setting: Setting, trial: range_trials.RangeTrial, found: torchcal.Localisation, file: Path
) -> None:
    """Figure 3."""
    pose = found.elements if setting.options.stage == "elements" else found.pixels
    if pose is None or found.matches is None:
        return
    lines = found.matches.measured.lines
    figure = edges_figure(trial.range, lines, setting.site, setting.sensor, pose.T_world_sensor)
    figure.savefig(file)


def mistake(options: Options) -> str | None:
    """What is wrong with the options, before anything is computed."""
    if options.trials < 1:
        return f"--trials {options.trials}: at least 1"
    try:
        offset(options.initial)
    except ValueError:
        return f"--initial {options.initial}: none, or metres,degrees such as 0.1,5"
    for name, file in (("json", options.json), ("picture", options.picture)):
        if file is not None and not file.absolute().parent.is_dir():
            return f"--{name} {file}: not a file in a folder that is there"
    return None


def main() -> None:
    options = tyro.cli(Options, description=__doc__)
    if (wrong := mistake(options)) is not None:
        sys.exit(wrong)
    if options.json is not None and options.picture is None:
        options = replace(options, picture=options.json.with_suffix(".png"))
    setting = Setting.of(options)
    trials = []
    for number in range(options.trials):
        trials.append(run_trial(setting, number))
        pixels = trials[-1]["pixels"]
        error = f"{1e3 * pixels['position_m']:8.3f} mm" if "position_m" in pixels else "no pose"
        print(f"{number:4} {trials[-1]['status']:12} {error}", file=sys.stderr, flush=True)
    text = json.dumps(summary(options, trials), indent=1) + "\n"
    sys.stdout.write(text)
    if options.json is not None:
        options.json.write_text(text)


if __name__ == "__main__":
    main()
