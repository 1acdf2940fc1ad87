"""Times, tables with ratios, and the sections of benchmarks.md that hold them."""

import os
import platform
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import partial
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path
from typing import Generic, TypeVar

import torch

REPORT = Path(__file__).parents[1] / "benchmarks.md"
"""Every measurement has its section there."""
NOTHING = "-"
TITLE = "# Benchmarks\n\nWritten by `scripts/benchmark.py`; do not edit.\n"

Result = TypeVar("Result")


@dataclass(frozen=True, kw_only=True, slots=True)
class Timed(Generic[Result]):
    """What a call returned."""

    result: Result
    seconds: float
    """On the wall clock."""


def timed(call: Callable[[], Result]) -> Timed[Result]:
    began = time.perf_counter()
    result = call()
    return Timed(result=result, seconds=time.perf_counter() - began)


def interleaved(
    calls: Mapping[str, Callable[[int], Result]], rounds: int
) -> dict[str, list[Timed[Result]]]:
    """Times every call once in each round, so that all share what else the machine does.

    Args:
        calls: By name; each is given the number of the round.
        rounds: How often each is called.
    """
    runs: dict[str, list[Timed[Result]]] = {name: [] for name in calls}
    for number in range(rounds):
        for name, call in calls.items():
            runs[name].append(timed(partial(call, number)))
    return runs


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """One program's row of a table."""

    program: str
    cells: Mapping[str, str] = field(default_factory=dict)
    """By heading."""
    seconds: float | None = None
    """None where the program could not be run."""


def missing(program: str, error: Exception) -> Row:
    """The row of a program that is not there."""
    return Row(program=f"{program}: missing ({error})")


def table(rows: Sequence[Row], seconds_of: str) -> str:
    """A Markdown table that ends with the seconds and their ratio to those of the first row.

    Args:
        rows: Their headings are those of the first row.
        seconds_of: What took the seconds, for the heading.
    """
    headings = ["program", *rows[0].cells, f"seconds for {seconds_of}", "ratio"]
    lines = [headings, ["---"] * len(headings)]
    lines += [_cells(row, list(rows[0].cells), rows[0].seconds) for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines) + "\n"


def _cells(row: Row, headings: Sequence[str], reference: float | None) -> list[str]:
    cells = [row.cells.get(heading, NOTHING) for heading in headings]
    if row.seconds is None:
        return [row.program, *cells, NOTHING, NOTHING]
    ratio = f"{row.seconds / reference:.3g}" if reference else NOTHING
    return [row.program, *cells, f"{row.seconds:.3g}", ratio]


def versions(*packages: str) -> str:
    """Packages with their versions, those that are installed."""
    installed = {package for package in packages if find_spec(package)}
    return ", ".join(f"{package} {version(package)}" for package in sorted(installed))


def machine() -> str:
    """What the figures were measured on, and when."""
    today = datetime.now(UTC).date().isoformat()
    return f"{_processor()}, {os.cpu_count()} cores, torch {torch.__version__}, {today}"


def _processor() -> str:
    details = Path("/proc/cpuinfo")
    text = details.read_text() if details.exists() else ""
    named = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return named[1] if named else platform.processor() or platform.machine()


def write_section(file: Path, name: str, body: str) -> None:
    """Writes one section, with the machine below its heading, and leaves the others as they are.

    Args:
        file: Begun where it does not exist.
        name: The heading of the section; a new one is added at the end.
        body: Markdown; headings in it are of the third level or below.
    """
    parts = re.split(r"^(?=## )", file.read_text() if file.exists() else TITLE, flags=re.MULTILINE)
    section = f"## {name}\n\n{machine()}\n\n{body.strip()}\n"
    places = [place for place, part in enumerate(parts) if part.startswith(f"## {name}\n")]
    if places:
        parts[places[0]] = section
    else:
        parts.append(section)
    file.write_text("\n".join(part.rstrip() + "\n" for part in parts))
