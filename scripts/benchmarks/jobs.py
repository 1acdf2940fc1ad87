"""A benchmark of jobs with known truth: made, answered by ICP, and any program's answers judged."""

import json
import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import trimesh
import tyro
from torch import Tensor

import torchcal
from torchcal.demo.range_trials import meshes_in_world
from torchcal.demo.swept_jobs import Truth, swept_jobs
from torchcal.demo.swept_score import (
    FOUND,
    SURE,
    Judged,
    judged,
    read_answer,
    read_truth,
    score,
    truth_data,
)
from torchcal.demo.swept_settings import TIERS

from .registration import open3d_icp
from .table import write_section

Folder = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")]
Results = Annotated[list[Path], tyro.conf.Positional, tyro.conf.arg(metavar="RESULTS")]

TRUTH = "truth.json"
Level = tuple[str, str]
"""A factor and its level."""
ABOUT = """\
Jobs with known truth in which one thing at a time gets worse: `scripts/benchmark.py generate
--tier {tier} --seed {seed}` ({jobs} jobs, images of {side} x {side} pixels cast by Embree; where
a factor is not swept: a room of eight boxes, 10 mm of noise, a beam of 3 pixels, a start that is
50 mm and 3 degrees off). Cells: answers that are right, of all; of those a program called usable
the median error; wrong and sure. Right is a usable answer within {found:g} mm and {found:g} mrad,
or, where the images cannot tell the pose (one or two planes, a symmetric room without a start), one
with the status `unobservable` or `ambiguous`. Wrong and sure is a usable answer more than {sure:g}
of its own sigmas off, or, from a program that states none, one that is not near.
"""


def generate(out: Path, *, tier: Literal["tiny", "small", "full"] = "small", seed: int = 0) -> None:
    """Jobs with truth, one factor swept at a time.

    Args:
        out: A new folder: `jobs` for every program to see, `truth.json` for none.
        tier: How many and how large.
        seed: Of everything.
    """
    if out.exists():
        raise SystemExit(f"{out}: found something there; expected a new folder")
    out.mkdir(parents=True)
    jobs = list(swept_jobs(TIERS[tier], seed))
    truths = {}
    for done, job in enumerate(jobs, start=1):
        truths[job.name] = truth_data(job.write(out / "jobs" / job.name))
        print(f"\r{done} of {len(jobs)} jobs", end="", flush=True)
    print()
    text = json.dumps({"tier": tier, "seed": seed, "truths": truths})
    (out / TRUTH).write_text(text, encoding="utf-8")


def icp(folder: Folder, out: Path) -> None:
    """Open3D's point-to-plane ICP on every job of a benchmark.

    Args:
        folder: That `generate` wrote.
        out: A new folder for one result.json for each job.
    """
    for file in sorted((folder / "jobs").glob("*/job.toml")):
        target = out / file.parent.name
        target.mkdir(parents=True)
        text = json.dumps(_icp_result(torchcal.read_job(file)))
        (target / "result.json").write_text(text, encoding="utf-8")


def score_results(folder: Folder, results: Results, *, out: Path | None = None) -> None:
    """Judges the answers of any programs.

    Args:
        folder: That `generate` wrote.
        results: One folder for each program, with JOB/result.json for each job; its name is the
            program's in the table.
        out: Where the section `jobs` is written; None: nowhere.
    """
    for program in results:
        if not program.is_dir():
            raise SystemExit(f"{program}: found no folder; expected one with JOB/result.json")
    if not (folder / TRUTH).is_file():
        raise SystemExit(f"{folder}: found no {TRUTH}; expected a folder that generate wrote")
    data = json.loads((folder / TRUTH).read_text(encoding="utf-8"))
    truths = {name: read_truth(folder / TRUTH, each) for name, each in data["truths"].items()}
    answers = {program.name: _judged(program, truths) for program in results}
    factors = {name: _by_factor(each) for name, each in answers.items()}
    text = f"{_table(factors)}\n{_table(answers)}"
    print(text)
    if out is not None:
        tier = TIERS[data["tier"]]
        about = ABOUT.format(
            tier=data["tier"],
            seed=data["seed"],
            jobs=len(truths),
            side=tier.side,
            found=1e3 * FOUND,
            sure=SURE,
        )
        write_section(out, "jobs", f"{about}\n{text}")


def _icp_result(job: torchcal.Job) -> dict[str, Any]:
    """What ICP finds, as ``result.json`` has it; it has no sigmas and is always sure."""
    assert job.world is not None
    mesh: Any = trimesh.util.concatenate(meshes_in_world(job.world))
    if job.initial == "anywhere":
        return {"status": "failed", "frames": []}
    localise = open3d_icp(mesh, job.sensor, block=1)
    starts = torchcal.Parameters.of(job, torchcal.build_job_scene(job))
    frames = [
        {"depth": frame.image.file, "T_world_sensor": _pose(localise, frame.image.range, start)}
        for frame, start in zip(job.frames, starts.sensor_poses(starts.nominal), strict=True)
    ]
    return {"status": "converged", "frames": frames}


def _pose(localise: Any, image: Tensor, start: Tensor) -> list[list[float]]:
    try:
        return localise(image, start).tolist()
    except RuntimeError:  # Open3D's word for too few points
        return start.tolist()


def _judged(program: Path, truths: Mapping[str, Truth]) -> dict[Level, list[Judged]]:
    """By factor and level."""
    answers: dict[Level, list[Judged]] = defaultdict(list)
    for name, truth in truths.items():
        answer = read_answer(program / name / "result.json")
        answers[truth.factor, truth.level].append(judged(answer, truth))
    return answers


def _by_factor(answers: Mapping[Level, list[Judged]]) -> dict[Level, list[Judged]]:
    """All levels of each factor together."""
    factors: dict[Level, list[Judged]] = defaultdict(list)
    for (factor, _), each in answers.items():
        factors[factor, "all"] += each
    return factors


def _table(programs: Mapping[str, Mapping[Level, list[Judged]]]) -> str:
    """A Markdown table: a row for each level, three columns for each program."""
    heading = ["factor", "level"]
    for program in programs:
        heading += [f"{program}: right", "median error", "wrong and sure"]
    lines = [heading, ["---"] * len(heading)]
    for level in next(iter(programs.values())):
        lines.append([*level, *(cell for of in programs.values() for cell in _cells(of[level]))])
    every = [[each for some in of.values() for each in some] for of in programs.values()]
    lines.append(["all", "all", *(cell for each in every for cell in _cells(each))])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _cells(answers: list[Judged]) -> list[str]:
    of = score(answers)
    error = "-"
    if math.isfinite(of.position):
        error = f"{1e3 * of.position:.3g} mm, {1e3 * of.rotation:.3g} mrad"
    return [f"{of.found} of {of.jobs}", error, f"{of.deceived}"]
