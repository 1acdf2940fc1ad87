"""Measure torchcal beside other programs; each measurement writes its section of benchmarks.md."""

import tyro
from benchmarks import fleet, localise, render, solver

COMMANDS = {
    "solver": solver.measure,
    "render": render.measure,
    "localise": localise.measure,
    "fleet": fleet.measure,
}


def main() -> None:
    tyro.extras.subcommand_cli_from_dict(COMMANDS, description=__doc__)


if __name__ == "__main__":
    main()
