"""The poses of bricks (4.1) by torchcal, SciPy and Open3D, from the same correspondences."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from pathlib import Path
from statistics import median

import torch
from torch import Tensor

import torchcal
from torchcal.demo import brick

from .rivals import NEAR, STARTS, Solve, open3d_ransac, open3d_ransac_icp, scipy_multi_start
from .table import REPORT, Row, Timed, interleaved, missing, table, versions, write_section

PROTOCOLS: tuple[brick.Protocol, ...] = ("all-pairs", "one-to-one")
MANY, FEW = 100_000, 1_000
"""Most iterations of RANSAC: Open3D's default, and a hundredth of it."""
ROUNDS = 5
WARM_UP = 2
"""Trials that every program is given before its time counts."""
ABOUT = f"""\
Vertexes of a brick, half of the correspondences wrong (4.1 of the paper), with
`scripts/benchmark.py solver --trials {{trials}} --seed {{seed}} --scipy-trials {{scipy_trials}}`.
Success is within 0.1 m and 0.1 rad of the truth or of a pose that looks the same; rms of the norms
of the errors, over the successes. The programs take turns in {{rounds}} rounds: torchcal solves all
trials in each, as one batch, the others a new part of theirs one by one. Seconds are the median
over the rounds, scaled to {{trials}} trials where the column `trials` says fewer. Imports and the
first {WARM_UP} trials are not counted; nothing is held to one core. {{versions}}.

- torchcal: `find_element_poses`, with detection among all pairs and restarts.
- Open3D: `registration_ransac_based_on_correspondence` on the candidate pairs, {NEAR} m; "+ ICP" is
  `registration_icp` after it, which detects the correspondences again among all pairs.
- SciPy: `least_squares` over all candidate pairs, Cauchy loss of {NEAR} m, numerical derivatives,
  {STARTS} random rotations about the centre of the measured vertexes; the lowest cost wins.
"""


@dataclass(frozen=True, kw_only=True, slots=True)
class Program:
    """A way to solve the trials."""

    name: str
    prepare: Callable[[], Solve]
    """Raises ImportError or OSError where the program is not installed."""
    parts: list[slice]
    """The trials that it is given in each round."""


def measure(
    *,
    trials: int = 1000,
    seed: int = 0,
    scipy_trials: int = 50,
    rounds: int = ROUNDS,
    out: Path = REPORT,
) -> None:
    """Poses of bricks from half-wrong correspondences: torchcal, SciPy, Open3D.

    Args:
        trials: Bricks to draw.
        seed: Of all draws.
        scipy_trials: How many of them SciPy is given; it is slow.
        rounds: In how many turns the programs are timed.
        out: Where the section `solver` is written.
    """
    if min(trials, scipy_trials, rounds) < 1:
        raise ValueError(
            f"trials, SciPy's and rounds are {trials}, {scipy_trials}, {rounds}: below 1"
        )
    scipy_trials = min(scipy_trials, trials)
    rounds = min(rounds, scipy_trials)
    programs = [
        Program(name="torchcal", prepare=lambda: solve_with_torchcal, parts=[slice(None)] * rounds),
        *_open3d(_split(trials, rounds)),
        Program(
            name="SciPy, multi-start",
            prepare=scipy_multi_start,
            parts=_split(scipy_trials, rounds),
        ),
    ]
    tables = [
        f"### {protocol}\n\n{table(compare(programs, protocol, trials, seed), f'{trials} trials')}"
        for protocol in PROTOCOLS
    ]
    about = ABOUT.format(
        trials=trials,
        seed=seed,
        scipy_trials=scipy_trials,
        rounds=rounds,
        versions=versions("open3d", "scipy"),
    )
    body = "\n".join([about, *tables])
    print(body)
    write_section(out, "solver", body)


def _open3d(parts: list[slice]) -> list[Program]:
    rivals = {
        f"Open3D RANSAC, {MANY:,} iterations": partial(open3d_ransac, MANY),
        f"Open3D RANSAC, {MANY:,} iterations + ICP": partial(open3d_ransac_icp, MANY),
        f"Open3D RANSAC, {FEW:,} iterations + ICP": partial(open3d_ransac_icp, FEW),
    }
    return [Program(name=name, prepare=made, parts=parts) for name, made in rivals.items()]


def _split(trials: int, rounds: int) -> list[slice]:
    ends = [trials * number // rounds for number in range(rounds + 1)]
    return [slice(*pair) for pair in pairwise(ends)]


def solve_with_torchcal(trials: brick.BrickTrials, seed: int) -> Tensor:
    """All trials in one batch, as in ``brick_experiment.py``."""
    return torchcal.find_element_poses(
        brick.brick_model(),
        trials.measured,
        trials.candidates,
        generator=torch.Generator().manual_seed(seed),
        # All eight vertexes are there, so a good pose explains all eight.
        search=torchcal.ElementSearch(enough=1.0),
    ).T_measured_model


def compare(programs: list[Program], protocol: brick.Protocol, trials: int, seed: int) -> list[Row]:
    """One row for each program, in their order."""
    generator = torch.Generator().manual_seed(seed)
    drawn = brick.draw_trials(trials, protocol, generator=generator)
    solvers, absent = prepared(programs)
    parts = {program.name: program.parts for program in programs}
    calls = {}
    for name, solve in solvers.items():
        solve(_rows(drawn, slice(WARM_UP)), seed)
        calls[name] = partial(_solve_part, solve, drawn, parts[name], seed)
    runs = interleaved(calls, len(programs[0].parts))
    rows = {name: _row(name, parts[name], found, drawn) for name, found in runs.items()} | absent
    return [rows[program.name] for program in programs]


def prepared(programs: list[Program]) -> tuple[dict[str, Solve], dict[str, Row]]:
    """The programs that are installed, and rows that say which are not."""
    solvers, absent = {}, {}
    for program in programs:
        try:
            solvers[program.name] = program.prepare()
        except (ImportError, OSError) as error:
            absent[program.name] = missing(program.name, error)
    return solvers, absent


def _solve_part(
    solve: Solve, trials: brick.BrickTrials, parts: list[slice], seed: int, number: int
) -> Tensor:
    return solve(_rows(trials, parts[number]), seed + number)


def _rows(trials: brick.BrickTrials, rows: slice) -> brick.BrickTrials:
    return brick.BrickTrials(
        T_measured_brick=trials.T_measured_brick[rows],
        measured=trials.measured[rows],
        candidates=trials.candidates[rows],
    )


def _row(
    name: str, parts: list[slice], runs: list[Timed[Tensor]], trials: brick.BrickTrials
) -> Row:
    """Figures over all trials that the program was given; the last answer to each counts."""
    truth = trials.T_measured_brick
    T = torch.full_like(truth, torch.nan)
    solved = torch.zeros(len(T), dtype=torch.bool)
    for part, run in zip(parts, runs, strict=True):
        T[part] = run.result
        solved[part] = True
    each = [run.seconds / len(run.result) for run in runs]
    cells = {"trials": str(int(solved.sum()))} | figures(T[solved], truth[solved])
    return Row(program=name, cells=cells, seconds=len(T) * median(each))


def figures(T: Tensor, truth: Tensor) -> dict[str, str]:
    """Rate of success modulo symmetry and the rms errors of the successes."""
    twists = brick.errors(T, truth)
    is_success = brick.are_successes(twists)
    kept = is_success.any(-1)
    xi = twists[kept, is_success[kept].double().argmax(-1)]
    position, rotation = xi.split(3, -1)
    return {
        "success": f"{kept.double().mean():.1%}",
        "position rms": f"{_rms(position):.4f} m",
        "rotation rms": f"{_rms(rotation):.5f} rad",
    }


def _rms(errors: Tensor) -> float:
    return float(errors.square().sum(-1).mean().sqrt())
