"""One row for each job, and the files with all of them: CSV, and Parquet where pyarrow is."""

import csv
import io
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from torchcal.fleet.task import Record

RobotBy = Literal["folder", "job", "urdf"]
"""What tells robots apart: the folder above the job's, the job's own folder, the URDF's name."""

NO_ROBOT = "no robot"
PARAMETER_COLUMNS = ("", ".sigma")
"""What follows the name of a parameter in the columns of its value and its sigma."""

_DATE = re.compile(
    r"(?<!\d)(\d{4})[-_]?(\d{2})[-_]?(\d{2})"
    r"(?:[-_T ]?(\d{2})[-_:]?(\d{2})(?:[-_:]?(\d{2}))?)?(?!\d)"
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Row:
    """What became of one job."""

    job: str
    file: Path
    """The job file."""
    status: str
    """That of ``result.json``, or ``unreadable``, ``error``, ``killed`` or ``not run``."""
    message: str
    attempts: int
    """In the run that ended with this status."""
    record: Record | None
    """None where there is no result."""

    @property
    def usable(self) -> bool:
        """Whether there is an answer that can be used."""
        return self.record is not None and self.record.usable


def robot_of(row: Row, by: RobotBy | None) -> str:
    """Which robot a job belongs to.

    Args:
        row: The job.
        by: None: by the folder where names have more than one part, else by the URDF.
    """
    *folders, own = row.job.split("/")
    if by == "job":
        return own
    if folders and by != "urdf":
        return "/".join(folders)
    return (row.record.robot if row.record else None) or NO_ROBOT


def time_of(row: Row) -> datetime | None:
    """When a job was recorded: the last date in its name, or when its youngest image was written.

    A name's time is taken for UTC. None where the name has no date and there is no result.
    """
    for found in reversed(list(_DATE.finditer(row.job))):
        year, month, day, *clock = (part or "00" for part in found.groups())
        try:
            return datetime.fromisoformat(f"{year}-{month}-{day}T{':'.join(clock)}+00:00")
        except ValueError:
            continue
    return datetime.fromisoformat(row.record.recorded) if row.record else None


def cells(rows: Sequence[Row], by: RobotBy | None) -> list[dict[str, Any]]:
    """The table as plain values, the same keys in every row; None where there is nothing.

    Metres and radians; corrections are differences to what the job file believed.
    """
    names = dict.fromkeys(name for row in rows if row.record for name in row.record.corrections)
    return [{**_fixed(row, by), **_corrections(row.record, list(names))} for row in rows]


def _fixed(row: Row, by: RobotBy | None) -> dict[str, Any]:
    record, time = row.record, time_of(row)
    return {
        "job": row.job,
        "robot": robot_of(row, by),
        "time": None if time is None else time.isoformat(),
        "status": row.status,
        "usable": row.usable,
        "message": row.message,
        "attempts": row.attempts,
        "seconds": record.seconds if record else None,
        "frames": record.frames if record else None,
        "agreement": record.agreement if record else None,
        "file": str(row.file),
    }


def _corrections(record: Record | None, names: Sequence[str]) -> Mapping[str, float | None]:
    found = record.corrections if record else {}
    values: dict[str, float | None] = {}
    for name in names:
        correction = found.get(name)
        pair = (correction.value, correction.sigma) if correction else (None, None)
        values |= {f"{name}{end}": each for end, each in zip(PARAMETER_COLUMNS, pair, strict=True)}
    return values


def as_csv(table: Sequence[Mapping[str, Any]]) -> str:
    """The table with a heading; nothing where there is nothing."""
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(table[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(table)
    return text.getvalue()


def write_parquet(table: Sequence[Mapping[str, Any]], file: Path) -> bool:
    """Writes the table with a type for each column; False, and no such file, without pyarrow."""
    try:
        arrow, parquet = import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        file.unlink(missing_ok=True)
        return False
    kinds = {"usable": arrow.bool_(), "attempts": arrow.int64(), "frames": arrow.int64()}
    texts = dict.fromkeys(("job", "robot", "status", "message", "file"), arrow.string())
    kinds |= texts | {"time": arrow.timestamp("us", tz="UTC")}
    columns = {name: [row[name] for row in table] for name in table[0]}
    columns["time"] = [time and datetime.fromisoformat(time) for time in columns["time"]]
    schema = arrow.schema([(name, kinds.get(name, arrow.float64())) for name in columns])
    partial = file.with_name(f".{file.name}.partial")
    parquet.write_table(arrow.table(columns, schema=schema), partial)
    os.replace(partial, file)
    return True


def write_text(text: str, file: Path) -> None:
    """Writes a text file as a whole or not at all."""
    partial = file.with_name(f".{file.name}.partial")
    partial.write_text(text, encoding="utf-8")
    os.replace(partial, file)
