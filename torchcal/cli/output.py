"""Writing a folder as a whole or not at all."""

import ctypes
import os
import shutil
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath

from torchcal.cli.unfinished import clear_leftovers, put_aside, unfinished
from torchcal.errors import TorchcalError

MARKERS = ("result.json", "preview")
"""What every folder that torchcal wrote holds, here or in ``result`` (the demo)."""

FRAMES = "frames.jsonl"
"""What torchcal follow writes a line of each frame into."""

WRITTEN = ("result.json", FRAMES, "report.html", "robot.urdf", "world.glb", "hybrid/*.png")
WRITTEN += ("comparison/*.png", "depth/*.npy", "preview/*.png", "batch.json", "frames/*.npz")
WRITTEN += ("model/*.glb", "model/record.json", "model/*.lock")
WRITTEN += (".world.partial-*.glb", ".report.partial-*.html")
"""Files that torchcal writes."""

WRITTEN_FOLDERS = ("meshes", "job")
"""Folders whose files have names that the robot or the demo choose."""


@contextmanager
def replaced_folder(folder: Path, inputs: tuple[Path, ...] = ()) -> Iterator[Path]:
    """Gives an empty folder to write into; it takes the place of ``folder`` if nothing fails.

    Args:
        folder: Need not exist; what it holds is lost at the end.
        inputs: Files that must survive.

    Raises:
        TorchcalError: If ``folder`` holds an input or something that torchcal did not write, is no
            folder, or cannot be written, or the disk is full.
    """
    target = folder.resolve()
    clear_leftovers([target])
    refuse_to_lose(target, inputs)
    try:
        with unfinished(target) as partial:
            yield partial
            _swap(partial, target)
    except OSError as error:
        # What cannot be opened names its file; a write that fails, on a full disk, names none.
        if error.filename is not None:
            raise
        raise TorchcalError(
            f"--out {target}: found {error.strerror or error} while it was written; expected room "
            "for the results; what was there before is as it was"
        ) from error


def refuse_to_lose(folder: Path, inputs: tuple[Path, ...] = ()) -> None:
    """Raises unless ``folder`` may be replaced.

    Raises:
        TorchcalError: As ``replaced_folder``.
    """
    for file in inputs:
        if file.resolve().is_relative_to(folder):
            raise TorchcalError(
                f"--out {folder}: found the input {file} in it; expected another folder, because "
                "it is replaced as a whole"
            )
    if not folder.exists():
        return
    if not folder.is_dir():
        raise TorchcalError(f"--out {folder}: found a file; expected a folder or nothing")
    foreign = foreign_file(folder)
    if foreign is not None:
        raise TorchcalError(
            f"--out {folder}: found {foreign.relative_to(folder)}, which torchcal did not write; "
            "expected an empty folder, an earlier result or nothing, because it is replaced as a "
            "whole"
        )


def foreign_file(folder: Path) -> Path | None:
    """A file below ``folder`` that torchcal did not write; None if there is none."""
    files = sorted(path for path in folder.rglob("*") if not path.is_dir())
    marked = any((folder / part / mark).exists() for part in ("", "result") for mark in MARKERS)
    for file in files:
        if not marked or not _is_ours(file.relative_to(folder)):
            return file
    return None


def _is_ours(path: PurePath) -> bool:
    """Whether a path relative to an output folder is one that torchcal writes."""
    parts = path.parts[1:] if path.parts[0] == "result" else path.parts
    inside = PurePath(*parts)
    named = any(
        inside.match(pattern) and len(parts) == len(PurePath(pattern).parts) for pattern in WRITTEN
    )
    return named or (len(parts) > 1 and parts[0] in WRITTEN_FOLDERS)


def input_files(job: Path) -> tuple[Path, ...]:
    """The job file and every file that it names, without checking anything else of it."""
    if not _is_file(job):
        return (job,)
    try:
        table = tomllib.loads(job.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return (job,)
    named = (job.parent / text for text in _texts(table))
    return (job, *(file for file in named if _is_file(file)))


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):
        return False


def _texts(value: object) -> Iterator[str]:
    """Every string of a nested table."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for each in value.values():
            yield from _texts(each)
    elif isinstance(value, list):
        for each in value:
            yield from _texts(each)


def _swap(partial: Path, target: Path) -> None:
    """Puts the partial folder in the place of the target, which comes back if that fails."""
    if not target.exists():
        partial.rename(target)
        return
    if _exchanged(partial, target):
        return
    old = put_aside(target)
    target.rename(old)
    try:
        partial.rename(target)
    except BaseException:
        old.rename(target)
        raise
    shutil.rmtree(old, ignore_errors=True)


def _exchanged(one: Path, other: Path) -> bool:
    """Lets two folders change places in one step; False where the system cannot do that.

    Two renames would do as well, but a process killed between them leaves no folder at all.
    """
    try:
        rename = ctypes.CDLL(None).renameat2
    except (AttributeError, OSError, TypeError):
        return False
    here, exchange = -100, 2  # AT_FDCWD and RENAME_EXCHANGE of Linux
    return rename(here, os.fsencode(one), here, os.fsencode(other), exchange) == 0
