"""``torchcal batch``: which jobs are to be done, where, and what became of all of them."""

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from importlib import import_module
from pathlib import Path

from filelock import FileLock, Timeout
from rich.console import Console

from torchcal.cli.batch_job import run_job
from torchcal.cli.commands import INTERRUPTED, NOT_USABLE, UNREADABLE, USABLE, device, line
from torchcal.cli.console import write
from torchcal.cli.options import Batch
from torchcal.cli.output import input_files
from torchcal.cli.progress import progress
from torchcal.cli.result_files import as_json
from torchcal.cli.unfinished import clear_leftovers
from torchcal.errors import TorchcalError
from torchcal.fleet import table
from torchcal.fleet.ledger import find_jobs, fingerprint, finished, read_record
from torchcal.fleet.page import page
from torchcal.fleet.processes import Processes
from torchcal.fleet.schedule import Here, Place, run_all
from torchcal.fleet.table import Row
from torchcal.fleet.task import End, Ended, Record, Task

LOCK = ".torchcal-batch.lock"
MOST_LINES = 20
"""Of jobs without a usable answer, on the terminal."""


def run_batch(command: Batch, out: Console, err: Console) -> int:
    """``torchcal batch``; returns the exit status."""
    _check(command)
    tasks = _tasks(command, find_jobs(command.jobs))
    with _alone(command.out):
        clear_leftovers(task.folder for task in tasks)
        before = {task.name: record for task in tasks if (record := finished(task)) is not None}
        todo = [task for task in tasks if task.name not in before]
        outdated = {task.name for task in todo if read_record(task.folder) is not None}
        ended, interrupted = _run(command, todo, len(before), err)
        rows = [_row(task, before.get(task.name), ended.get(task.name)) for task in tasks]
        parquet = _write(command, rows)
    if command.options.json:
        found = {"jobs": table.cells(rows, command.robot)}
        write(out, as_json(found) + "\n")
    else:
        _tell(command, rows, (len(before), len(outdated & ended.keys())), parquet, out)
    return _status(rows, interrupted)


def _check(command: Batch) -> None:
    """Raises for numbers that make no sense and for a device that this machine lacks."""
    for option, value in (("--workers", command.workers), ("--attempts", command.attempts)):
        if value is not None and value < 1:
            raise TorchcalError(f"{option}: found {value}; expected 1 or more")
    if not command.jobs:
        raise TorchcalError("found no JOB; expected job files or folders of jobs")
    if command.ray is None:
        device(command.options)


def _tasks(command: Batch, jobs: Mapping[str, Path]) -> list[Task]:
    """Every job with what tells whether it changed."""
    tasks = []
    for name, job in jobs.items():
        folder = command.out / name
        inputs = input_files(job)
        for file in inputs:
            if file.resolve().is_relative_to(folder.resolve()):
                raise TorchcalError(
                    f"--out {command.out}: found {file}, which the job {name} needs, where its "
                    "result goes; expected another folder"
                )
        tasks.append(
            Task(
                name=name,
                job=job.resolve(),
                folder=folder.resolve(),
                fingerprint=fingerprint(job, inputs[1:], command.options.seed),
                seed=command.options.seed,
                device=command.options.device,
            )
        )
    return tasks


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keeps a second batch out of the folder; the system gives it free when this process dies."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError as error:
        raise TorchcalError(f"--out {folder}: found a file; expected a folder") from error
    try:
        with FileLock(folder / LOCK, timeout=0):
            yield
    except Timeout as error:
        raise TorchcalError(
            f"--out {folder}: found another batch that is writing into it; expected none"
        ) from error


def _run(
    command: Batch, todo: Sequence[Task], before: int, err: Console
) -> tuple[dict[str, Ended], bool]:
    """Does what is left to do; how each task ended, and whether Ctrl-C came before the end."""
    ended: dict[str, Ended] = {}
    if not todo:
        return ended, False
    place = _place(command, len(todo))
    try:
        # Ray tells of lost machines on standard output, which belongs to the answer.
        with redirect_stdout(sys.stderr), progress(err) as report:
            report("jobs", before / (before + len(todo)))
            for each in run_all(todo, place, attempts=command.attempts):
                ended[each.task.name] = each
                report("jobs", (before + len(ended)) / (before + len(todo)))
    except KeyboardInterrupt:
        return ended, True
    finally:
        place.close()
        clear_leftovers(task.folder for task in todo if task.name not in ended)
    return ended, False


def _place(command: Batch, jobs: int) -> Place:
    """Where the jobs run."""
    if command.ray is not None:
        gpus = command.options.device != "cpu"
        cluster = import_module("torchcal.fleet.ray_cluster").RayCluster
        return cluster(run_job, command.ray, workers=command.workers, gpus=gpus)
    if command.workers is not None:
        return Processes(run_job, min(command.workers, jobs))
    return Here(run_job)


def _row(task: Task, before: Record | None, ended: Ended | None) -> Row:
    """What became of a job, in this run or an earlier one."""
    record = before or (ended.record if ended else None)
    if record is not None:
        status, message, attempts = record.status, record.message, record.attempts
    elif ended is not None:
        status, message, attempts = ended.end.value, ended.message, ended.task.attempt
    else:
        status, message, attempts = "not run", "The batch was interrupted before.", 0
    return Row(
        job=task.name,
        file=task.job,
        status=status,
        message=message,
        attempts=attempts,
        record=record,
    )


def _write(command: Batch, rows: Sequence[Row]) -> bool:
    """The tables and the page; False where Parquet cannot be written."""
    folder = command.out
    cells = table.cells(rows, command.robot)
    table.write_text(table.as_csv(cells), folder / "fleet.csv")
    table.write_text(page(rows, command.robot), folder / "fleet.html")
    return table.write_parquet(cells, folder / "fleet.parquet")


def _tell(
    command: Batch, rows: Sequence[Row], before: tuple[int, int], parquet: bool, out: Console
) -> None:
    """The answer on standard output."""
    counts = Counter(row.status for row in rows)
    line(out, f"{len(rows)} jobs: {', '.join(f'{n} {name}' for name, n in counts.items())}")
    kept, again = before
    if kept:
        line(out, f"{kept} kept from an earlier run: the same job, files and seed")
    if again:
        line(out, f"{again} done again: the job, a file that it names or the seed has changed")
    doubtful = [row for row in rows if not row.usable]
    for row in doubtful[:MOST_LINES]:
        tries = f" after {row.attempts} attempts" if row.attempts > 1 else ""
        line(out, f"{row.job}: {row.status}{tries}: {row.message}")
    if len(doubtful) > MOST_LINES:
        line(out, f"and {len(doubtful) - MOST_LINES} more")
    files = "fleet.csv and fleet.parquet" if parquet else "fleet.csv"
    line(out, f"Open {command.out / 'fleet.html'}; every job is in {files} beside it")
    if not parquet:
        line(out, "No fleet.parquet: that needs pyarrow (pip install 'torchcal[fleet]')")


def _status(rows: Sequence[Row], interrupted: bool) -> int:
    if interrupted:
        return INTERRUPTED
    if all(row.usable for row in rows):
        return USABLE
    return UNREADABLE if all(row.status == End.UNREADABLE for row in rows) else NOT_USABLE
