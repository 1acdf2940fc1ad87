"""Many tiny jobs by `torchcal batch`: a plain loop, one and two workers, Ray."""

import os
import resource
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np
import trimesh

from torchcal.fleet.processes import ONE_THREAD

from .table import NOTHING, REPORT, Row, interleaved, table, versions, write_section

WALL, SIGMA, WIDTH, HEIGHT = 2.0, 0.01, 12, 9
JOB = f"""\
[world]
model = "cell.glb"
[sensor]
model = "pinhole"
width = {WIDTH}
height = {HEIGHT}
fx = 12.0
fy = 12.0
cx = 5.5
cy = 4.0
range = [0.3, 5.0]
sigma = {SIGMA}
drift = 0
[[frame]]
depth = "0001.npy"
pose = {{ xyz = [0, 0, 0] }}
[unknown.base]
position_sigma = [0, 0, 0.05]
rotation_sigma_deg = 0
"""
LOOP = """\
import sys, torch, torchcal
from pathlib import Path
for file in sorted(Path(sys.argv[1]).glob("*/job.toml")):
    generator = torch.Generator().manual_seed(0)
    calibration = torchcal.calibrate(torchcal.read_job(file), generator=generator)
    torchcal.write_results(calibration, Path(sys.argv[2]) / file.parent.name)
"""
COMMAND = "import sys; from torchcal.cli.main import main; sys.exit(main())"
LOOP_NAME = "plain loop"
LOCAL = {count: f"`--workers {count}`" for count in (1, 2)}
RAY = {count: f"`--ray local --workers {count}`" for count in (1, 2)}
ABOUT = """\
{jobs} jobs with one image of {width} x {height} pixels and one unknown, calibrated and written with
their pictures and reports, with `scripts/benchmark.py fleet --jobs {jobs} --rounds {rounds}`.
Every program has one thread a process and starts anew with an empty folder; they take turns in each
round, and their start (imports, the cluster) counts. Seconds are the median over the rounds. In
every run all jobs had a result. {versions}.

- plain loop: `read_job`, `calibrate`, `write_results`, one job after the other.

{found}
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Ran:
    """One run over all jobs."""

    results: int
    processor: float
    """Seconds of all processes that it started and waited for."""


def measure(*, jobs: int = 1000, rounds: int = 1, seed: int = 0, out: Path = REPORT) -> None:
    """Throughput of `torchcal batch` with one and two workers, and what it costs over a loop.

    Args:
        jobs: How many.
        rounds: How often each way is taken.
        seed: Of the images.
        out: Where the section `fleet` is written.
    """
    if min(jobs, rounds) < 1:
        raise ValueError(f"jobs and rounds are {jobs} and {rounds}; both must be at least 1")
    with TemporaryDirectory() as folder:
        write_jobs(Path(folder) / "jobs", jobs, np.random.default_rng(seed))
        ways = commands(Path(folder) / "jobs")
        calls = {name: _caller(command, Path(folder), jobs) for name, command in ways.items()}
        runs = interleaved(calls, rounds)
    seconds = {name: median(run.seconds for run in found) for name, found in runs.items()}
    rows = [
        _row(name, seconds[name], jobs, median(run.result.processor for run in runs[name]))
        for name in ways
    ]
    about = ABOUT.format(
        jobs=jobs,
        rounds=rounds,
        width=WIDTH,
        height=HEIGHT,
        versions=versions("ray"),
        found=_found(seconds),
    )
    body = f"{about}\n{table(rows, f'{jobs} jobs')}"
    print(body)
    write_section(out, "fleet", body)


def write_jobs(folder: Path, count: int, rng: np.random.Generator) -> None:
    """Jobs of a camera before a wall that is not quite where the model says."""
    wall = trimesh.creation.box((20.0, 20.0, 1.0)).apply_translation((0.0, 0.0, WALL + 0.5))
    scene = trimesh.Scene()
    scene.add_geometry(wall, node_name="wall")
    for number in range(count):
        job = folder / f"{number:05d}"
        job.mkdir(parents=True)
        scene.export(job / "cell.glb")
        ranges = WALL + rng.normal(0.0, 0.02) + rng.normal(0.0, SIGMA, (HEIGHT, WIDTH))
        np.save(job / "0001.npy", ranges.astype(np.float32))
        (job / "job.toml").write_text(JOB, encoding="utf-8")


def commands(jobs: Path) -> dict[str, list[str]]:
    """Every way, by name: a command without the folder of its results, which comes last."""
    batch = [sys.executable, "-c", COMMAND, "batch", str(jobs)]
    ways = {
        LOOP_NAME: [sys.executable, "-c", LOOP, str(jobs)],
        **{name: [*batch, "--workers", str(n), "--out"] for n, name in LOCAL.items()},
    }
    if find_spec("ray"):
        for n, name in RAY.items():
            ways[name] = [*batch, "--ray", "local", "--workers", str(n), "--out"]
    return ways


def _caller(command: Sequence[str], folder: Path, jobs: int) -> Callable[[int], Ran]:
    def call(number: int) -> Ran:
        with TemporaryDirectory(dir=folder) as out:
            before = _processor()
            subprocess.run(
                [*command, out], check=True, env={**os.environ, **ONE_THREAD}, capture_output=True
            )
            results = len(list(Path(out).glob("*/result.json")))
            if results != jobs:
                raise RuntimeError(f"round {number}: {results} results of {jobs} jobs")
            return Ran(results=results, processor=_processor() - before)

    return call


def _processor() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _row(name: str, seconds: float, jobs: int, processor: float) -> Row:
    # Ray's workers are nobody's children that could be asked.
    used = NOTHING if name in RAY.values() else f"{processor:.3g}"
    cells = {"jobs a second": f"{jobs / seconds:.3g}", "processor seconds": used}
    return Row(program=name, cells=cells, seconds=seconds)


def _found(seconds: Mapping[str, float]) -> str:
    """The figures that matter, in words."""
    over = 100.0 * (seconds[LOCAL[1]] / seconds[LOOP_NAME] - 1.0)
    found = [f"Over the plain loop, one worker takes {over:+.1f} %."]
    for names, where in ((LOCAL, "on this machine"), (RAY, "through Ray")):
        if names[1] in seconds:
            ratio = seconds[names[1]] / seconds[names[2]]
            found.append(f"Two workers do {ratio:.2f} times as much as one {where}.")
    return " ".join(found)
