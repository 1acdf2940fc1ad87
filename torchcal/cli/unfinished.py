"""Folders that are being written beside those whose place they will take.

Who writes one holds a lock of the system on it, which is free again when its process dies, however
it dies: what is left of a killed process can be told from what another one is writing now.
"""

import glob
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from torchcal.errors import TorchcalError

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

_LEFTOVER = re.compile(r"\.(.+)\.(partial|old)-[0-9a-f]{8}")
"""What a folder is called while it is written or replaced."""


@contextmanager
def unfinished(target: Path) -> Iterator[Path]:
    """A new folder beside the target, with the permissions that a new folder gets; gone at the end.

    Raises:
        TorchcalError: If there is no place for it.
    """
    partial, lock = _locked_folder(target)
    try:
        yield partial
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def put_aside(target: Path) -> Path:
    """Another name for the target, until something else has taken its place."""
    return target.with_name(f".{target.name}.old-{secrets.token_hex(4)}")


def newest(folder: Path, name: str) -> Path | None:
    """A file of a folder, or of the one that is being written to take its place."""
    target = folder.resolve()
    beside = target.parent.glob(f".{glob.escape(target.name)}.partial-*")
    folders = (target, *(path for path in beside if not _is_abandoned(path)))
    files = [each / name for each in folders if (each / name).is_file()]
    return max(files, key=lambda file: file.stat().st_mtime_ns, default=None)


def clear_leftovers(folders: Iterable[Path]) -> None:
    """Removes what killed processes left half written beside these folders, or half replaced."""
    names: dict[Path, set[str]] = {}
    for folder in folders:
        target = folder.resolve()
        names.setdefault(target.parent, set()).add(target.name)
    for parent, known in names.items():
        found = [(path, _LEFTOVER.fullmatch(path.name)) for path in _content(parent)]
        ours = [(path, match[1], match[2]) for path, match in found if match and match[1] in known]
        # Who still writes may be about to take the place of what it has put aside.
        busy = {name for path, name, kind in ours if kind == "partial" and _is_held(path)}
        for path, name, kind in ours:
            if kind == "old" and name not in busy:
                _restore(path, parent / name)


def _restore(old: Path, target: Path) -> None:
    """Gives a folder its name again that was put aside, unless another one bears it."""
    if target.exists():
        shutil.rmtree(old, ignore_errors=True)
    else:
        with suppress(OSError):  # another run was quicker
            old.rename(target)


def _content(folder: Path) -> list[Path]:
    try:
        return list(folder.iterdir())
    except OSError:
        return []


def _locked_folder(target: Path) -> tuple[Path, int | None]:
    """A new folder and the lock on it; None where the system has no locks for folders."""
    while True:
        partial = target.with_name(f".{target.name}.partial-{secrets.token_hex(4)}")
        try:
            partial.mkdir(parents=True)
        except OSError as error:
            words = f"found {error.strerror or error}; expected a place that can be written"
            raise TorchcalError(f"--out {target}: {words}") from error
        try:
            lock = _lock(partial)
        except (BlockingIOError, FileNotFoundError):  # another process took it for abandoned
            shutil.rmtree(partial, ignore_errors=True)
            continue
        if lock is None or partial.is_dir():
            return partial, lock
        os.close(lock)


def _lock(folder: Path) -> int | None:
    """Locks a folder for as long as the file that is returned is open; None: nobody can say.

    Raises:
        BlockingIOError: If another process holds the lock.
    """
    if fcntl is None:
        return None
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise
    except OSError:  # some file systems on a network
        os.close(handle)
        return None
    return handle


def _is_abandoned(partial: Path) -> bool:
    """Whether it is sure that nobody writes into a folder any more."""
    try:
        lock = _lock(partial)
    except OSError:
        return False
    if lock is not None:
        os.close(lock)
    return lock is not None


def _is_held(partial: Path) -> bool:
    """Whether somebody writes into a folder; removes it if it is sure that nobody does."""
    try:
        lock = _lock(partial)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    if lock is not None:
        shutil.rmtree(partial, ignore_errors=True)
        os.close(lock)
    return False
