"""Which jobs there are, and which of them are finished: what makes a batch resumable.

A job is finished when its folder holds a result and a record with the job's fingerprint; both come
into being together, because the folder does.
"""

import hashlib
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path, PurePosixPath

from torchcal.errors import TorchcalError
from torchcal.fleet.task import Correction, Record, Task

JOB_FILE = "job.toml"
RECORD_FILE = "batch.json"
RESULT_FILE = "result.json"


def find_jobs(places: Sequence[Path]) -> dict[str, Path]:
    """Job files by the names that their results get.

    Args:
        places: Job files, and folders whose ``job.toml`` files are all taken. A job below a folder
            is named by its path from there, a job file by itself or, if it is a ``job.toml``, by
            the folder that holds it.

    Raises:
        TorchcalError: If a place does not exist or holds no job, or names are not unique.
    """
    jobs: dict[str, Path] = {}
    for place in places:
        for name, file in _jobs_of(place):
            if jobs.get(name, file).resolve() != file.resolve():
                raise TorchcalError(
                    f"{file}: found a job of the name {name}, which {jobs[name]} has too; expected "
                    "different names: give the folder above both, then their paths are their names"
                )
            jobs[name] = file
    _refuse_nested(jobs)
    return jobs


def _jobs_of(place: Path) -> list[tuple[str, Path]]:
    if place.is_file():
        return [(_name_of(place), place)]
    if not place.is_dir():
        raise TorchcalError(f"{place}: found nothing; expected a job file or a folder of jobs")
    files = sorted(file for file in place.rglob(JOB_FILE) if not _hidden(file.relative_to(place)))
    if not files:
        raise TorchcalError(f"{place}: found no {JOB_FILE} in it; expected a folder of jobs")
    below = [(file.parent.relative_to(place).as_posix(), file) for file in files]
    return [(_name_of(file) if name == "." else name, file) for name, file in below]


def _name_of(file: Path) -> str:
    return file.resolve().parent.name if file.name == JOB_FILE else file.stem


def _hidden(path: Path) -> bool:
    return any(part.startswith(".") for part in path.parts)


def _refuse_nested(names: Iterable[str]) -> None:
    """A result is replaced as a whole: nothing else may lie in its folder."""
    known = set(names)
    for name in sorted(known):
        for above in PurePosixPath(name).parents:
            if str(above) in known:
                raise TorchcalError(
                    f"found the jobs {above} and {name}; expected none in the folder of another, "
                    "because their results would lie in each other: give the job files themselves"
                )


def fingerprint(job: Path, inputs: Iterable[Path], seed: int) -> str:
    """Changes when the job file, a file that it names, or the seed does.

    Of the files that a job names (images above all) only size and time of change are looked at.

    Args:
        job: The job file.
        inputs: The files that it names.
        seed: Of the run.
    """
    digest = hashlib.sha256(f"seed {seed}\n".encode())
    try:
        # A pipe would be read for ever; that it is no job is for the reader of jobs to say.
        digest.update(job.read_bytes() if job.is_file() else b"")
    except OSError as error:
        digest.update(str(error.errno).encode())
    for file in inputs:
        state = file.stat()
        digest.update(f"\n{file.name} {state.st_size} {state.st_mtime_ns}".encode())
    return digest.hexdigest()


def write_record(record: Record, folder: Path) -> None:
    """Puts a record beside a result that is being written."""
    text = json.dumps(asdict(record), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / RECORD_FILE).write_text(text + "\n", encoding="utf-8")


def finished(task: Task) -> Record | None:
    """The record of a task that is done; None if it is not, or was before its job changed."""
    record = read_record(task.folder)
    return record if record and record.fingerprint == task.fingerprint else None


def read_record(folder: Path) -> Record | None:
    """The record of a finished job; None where there is none that this version can read."""
    if not (folder / RESULT_FILE).is_file():
        return None
    try:
        data = json.loads((folder / RECORD_FILE).read_text(encoding="utf-8"))
        known = {field.name for field in fields(Record)}
        kept = {key: value for key, value in data.items() if key in known}
        found = {name: Correction(**each) for name, each in data["corrections"].items()}
        return Record(**{**kept, "corrections": found})
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return None
