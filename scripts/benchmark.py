"""Measure torchcal beside other programs; each measurement writes its section of benchmarks.md.

``generate`` writes jobs with known truth, ``icp`` answers them, ``score`` judges any answers.
"""

import tyro
from benchmarks import fleet, jobs, localise, memory, render, solver

COMMANDS = {
    "solver": solver.measure,
    "render": render.measure,
    "localise": localise.measure,
    "fleet": fleet.measure,
    "memory": memory.measure,
    "generate": jobs.generate,
    "icp": jobs.icp,
    "score": jobs.score_results,
}


def main() -> None:
    tyro.extras.subcommand_cli_from_dict(COMMANDS, description=__doc__)


if __name__ == "__main__":
    main()
