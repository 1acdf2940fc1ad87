"""The pose of a sensor from one range image (4.2) by torchcal and others, from the same images."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
import trimesh
from torch import Tensor

from torchcal.demo import range_trials
from torchcal.demo.machine_hall import machine_hall
from torchcal.demo.range_trials import RangeTrial

from .own import torchcal_all, torchcal_pixels
from .registration import Localise, Prepare, open3d_features, open3d_icp, small_gicp
from .table import REPORT, Row, Timed, missing, table, timed, versions, write_section

STARTS: Mapping[str, tuple[float, float] | None] = {
    "0.1 m, 5 degrees": (0.1, math.radians(5.0)),
    "0.3 m, 15 degrees": (0.3, math.radians(15.0)),
    "none": None,
}
"""How far off the starting values are."""
FROM_START: Mapping[str, Prepare] = {
    "torchcal, elements and pixels": torchcal_all,
    "torchcal, pixels alone": torchcal_pixels,
    "Open3D ICP, point to plane, Tukey": open3d_icp,
    "small_gicp GICP": small_gicp,
}
FROM_ANYWHERE: Mapping[str, Prepare] = {
    "torchcal, elements and pixels": torchcal_all,
    "Open3D FPFH + RANSAC + ICP": open3d_features,
}
FOUND = 0.1
"""Largest error (m and rad) of a pose that counts as found."""
ABOUT = """\
The pose of a sensor in a machine hall from one range image (4.2 of the paper: 512 x 512, 50
degrees, N = 10, sigma 5 cm), with `scripts/benchmark.py localise --trials {trials} --seed {seed}`.
The images are made by casting rays, with supersampling; all programs get the same ones, take turns,
and know the mesh of the hall beforehand. Found is within {found} m and {found} rad of the truth;
rms of the norms of the errors, over what was found. Seconds are the median over the images.
{versions}.

- torchcal: counts as found only where its status is `converged`.
- ICP and GICP: points are means of 4 x 4 pixels, the model's points what rays meet from the
  starting value, in a wider view; four runs with ever nearer partners.
- FPFH + RANSAC: features of the image's points and of points all over the hall; then the same ICP.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Program:
    """A way to find poses, ready for images."""

    name: str
    localise: Localise | None
    """None where it is not installed."""
    absent: Row | None
    """What the table says then."""


def measure(*, trials: int = 20, seed: int = 0, out: Path = REPORT) -> None:
    """Poses from range images of a hall: torchcal, Open3D, small_gicp.

    Args:
        trials: Images for each starting value.
        seed: Of all draws.
        out: Where the section `localise` is written.
    """
    if trials < 1:
        raise ValueError(f"trials is {trials}; it must be at least 1")
    mesh: Any = trimesh.util.concatenate(range_trials.meshes_in_world(machine_hall()))
    drawn = [draw(seed, number) for number in range(trials)]
    near, far = prepared(FROM_START, mesh), prepared(FROM_ANYWHERE, mesh)
    tables = []
    for start, offset in STARTS.items():
        rows = compare(far if offset is None else near, [trial[start] for trial in drawn])
        tables.append(f"### from {start}\n\n{table(rows, 'an image')}")
        print(tables[-1], flush=True)
    about = ABOUT.format(
        trials=trials, seed=seed, found=FOUND, versions=versions("open3d", "small_gicp")
    )
    write_section(out, "localise", "\n".join([about, *tables]))


def draw(seed: int, number: int) -> dict[str, RangeTrial]:
    """One image with every starting value."""
    trial = range_trials.draw_trial(seed, number, offset=None)
    return {
        name: range_trials.with_start(trial, seed, number, offset)
        for name, offset in STARTS.items()
    }


def prepared(programs: Mapping[str, Prepare], mesh: trimesh.Trimesh) -> list[Program]:
    """The programs that are installed, and rows that say which are not."""
    sensor = range_trials.range_sensor()
    ready = []
    for name, prepare in programs.items():
        try:
            ready.append(Program(name=name, localise=prepare(mesh, sensor), absent=None))
        except (ImportError, OSError) as error:
            ready.append(Program(name=name, localise=None, absent=missing(name, error)))
    return ready


def compare(programs: list[Program], trials: list[RangeTrial]) -> list[Row]:
    """One row for each program: they take turns image by image."""
    runs: dict[str, list[Timed[Tensor]]] = {program.name: [] for program in programs}
    calls: dict[str, Callable[[RangeTrial], Tensor]] = {
        program.name: partial(_pose, program.localise)
        for program in programs
        if program.localise is not None
    }
    for trial in (trials[0], *trials):  # the first warms up
        for name, call in calls.items():
            runs[name].append(timed(partial(call, trial)))
    return [
        program.absent or _row(program.name, runs[program.name][1:], trials) for program in programs
    ]


def _pose(localise: Localise, trial: RangeTrial) -> Tensor:
    return localise(trial.range, trial.start)


def _row(name: str, runs: list[Timed[Tensor]], trials: list[RangeTrial]) -> Row:
    T = torch.stack([run.result for run in runs])
    truth = torch.stack([trial.T_world_sensor for trial in trials])
    position, rotation = range_trials.errors(T, truth)
    found = (position < FOUND) & (rotation < FOUND)
    cells = {"found": f"{int(found.sum())} of {len(trials)}"}
    if found.any():
        cells["position rms"] = f"{1e3 * _rms(position[found]):.2f} mm"
        cells["rotation rms"] = f"{1e3 * _rms(rotation[found]):.2f} mrad"
    return Row(program=name, cells=cells, seconds=median(run.seconds for run in runs))


def _rms(errors: Tensor) -> float:
    return float(errors.square().mean().sqrt())
