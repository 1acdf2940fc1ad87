"""``torchcal``: the command line and what its exit status says.

0: the answer can be used. 2: the job cannot be read or the command was mistyped. 3: the job was
read, the answer cannot be used, and the results say why. 130: interrupted.
"""

from collections.abc import Callable
from typing import Any

from rich.console import Console

from torchcal.cli import commands
from torchcal.cli.batch import run_batch
from torchcal.cli.console import Speaker
from torchcal.cli.follow import run_follow
from torchcal.cli.import_recording import run_import
from torchcal.cli.options import (
    Batch,
    Calibrate,
    Check,
    Command,
    Demo,
    Follow,
    Import,
    Render,
    Update,
    View,
    parse,
)
from torchcal.cli.update import run_update
from torchcal.cli.view import run_view
from torchcal.errors import TorchcalError


def main(arguments: list[str] | None = None) -> int:
    """Runs one command and returns its exit status; mistakes become one line on standard error.

    Raises:
        SystemExit: For ``--help`` and for what the command line does not know.
    """
    command = parse(arguments)
    out, err = Speaker(), Speaker(stderr=True)
    try:
        return _runner(command)(command, out, err)
    except (TorchcalError, OSError) as error:
        words = " ".join(str(error).split())
        err.print(f"error: {words}", markup=False, highlight=False, soft_wrap=True)
        return commands.UNREADABLE
    except KeyboardInterrupt:
        err.print("interrupted: nothing was written", markup=False)
        return commands.INTERRUPTED


def _runner(command: Command) -> Callable[[Any, Console, Console], int]:
    """What carries out a command."""
    return {
        Calibrate: commands.run_calibrate,
        Follow: run_follow,
        Render: commands.run_render,
        Check: commands.run_check,
        Batch: run_batch,
        Import: run_import,
        View: run_view,
        Update: run_update,
        Demo: commands.run_demo,
    }[type(command)]
