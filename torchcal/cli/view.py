"""``torchcal view``: the operator's view in a browser, until the program is interrupted."""

import importlib.util
import socket
import sys
from contextlib import redirect_stdout
from functools import partial

from rich.console import Console

from torchcal.calibrate import calibrate
from torchcal.calibrate.followed import Followed
from torchcal.calibrate.kept_result import kept
from torchcal.cli.commands import USABLE, device, generator, line, print_json
from torchcal.cli.options import View
from torchcal.cli.output import FRAMES
from torchcal.cli.progress import progress
from torchcal.cli.unfinished import newest
from torchcal.display.view.follow import FollowSource
from torchcal.display.view.source import FolderSource, KeptSource, Source
from torchcal.errors import TorchcalError
from torchcal.model.read_job import read_job, read_recording

PORT = 8080
"""Where a search for a free port begins."""


def run_view(command: View, out: Console, err: Console) -> int:
    """``torchcal view``; returns the exit status."""
    if importlib.util.find_spec("viser") is None:
        raise TorchcalError(
            "torchcal view: found no viser; expected the extra view: pip install 'torchcal[view]'"
        )
    from torchcal.display.view.app import View as Window  # noqa: PLC0415, needs viser

    _check_address(command.host, command.port)
    source = source_of(command, err)
    with redirect_stdout(sys.stderr):  # viser tells its address there, too
        port = PORT if command.port is None else command.port
        window = Window(source, host=command.host, port=port)
    if command.options.json:
        print_json({"address": window.address}, out)
    else:
        line(out, f"Open {window.address} in a browser; stop with Ctrl-C")
    out.file.flush()
    try:
        window.watch()
    except KeyboardInterrupt:
        pass
    finally:
        with redirect_stdout(sys.stderr):
            window.stop()
    return USABLE


def _check_address(host: str, port: int | None) -> None:
    """Raises unless this machine can listen there, before anything long is done."""
    asked = f"--host {host}" if port is None else f"--host {host} --port {port}"
    expected = "--host and --port of this machine where nobody listens yet"
    if not host:
        raise TorchcalError(f"--host: found nothing; expected {expected}")
    try:
        found = socket.getaddrinfo(host, port or 0, type=socket.SOCK_STREAM)
        family, kind, protocol, _, address = found[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(address)
    except (OSError, OverflowError, UnicodeError) as error:
        raise TorchcalError(f"{asked}: found {error}; expected {expected}") from error


def source_of(command: View, err: Console) -> Source:
    """What a person asked to see.

    Raises:
        TorchcalError: If it cannot be read.
    """
    place = command.result
    if command.follow is not None:
        recording = read_recording(place, device=device(command.options))
        return FollowSource(Followed.of(recording), partial(newest, command.follow, FRAMES))
    if not place.is_dir():
        return _nominal(command, err)
    if (place / FRAMES).is_file():
        raise TorchcalError(
            f"{place}: found what torchcal follow wrote; expected its job: "
            f"torchcal view JOB --follow {place}"
        )
    return FolderSource(place)


def _nominal(command: View, err: Console) -> KeptSource:
    """A job before anything is estimated."""
    job = read_job(command.result, device=device(command.options))
    draws = generator(command.options)
    with progress(err) as report:
        calibration = calibrate(job, estimate=False, generator=draws, progress=report)
    return KeptSource(kept(calibration))
