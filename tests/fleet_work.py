"""What workers of other processes do in tests: found by name, so it stands in a module."""

import os
import signal
import time
from dataclasses import replace
from pathlib import Path

from torchcal.errors import JobError
from torchcal.fleet.task import Record, Task


def task(name: str, folder: Path) -> Task:
    return Task(name=name, job=folder / f"{name}.toml", folder=folder / name, fingerprint=name)


def record(each: Task) -> Record:
    """An answer that can be used, and says which process gave it."""
    return Record(
        fingerprint=each.fingerprint,
        status="converged",
        usable=True,
        message=f"process {os.getpid()}",
        attempts=each.attempt,
        seconds=0.0,
        frames=1,
        agreement=1.0,
        robot=None,
        recorded="2026-01-01T00:00:00+00:00",
        corrections={},
    )


def work(each: Task) -> Record:
    """Does what the task is called: fine, broken, wrong, dies, dies-once or waits."""
    if each.name.startswith("broken"):
        raise RuntimeError("out of\nluck")
    if each.name.startswith("wrong"):
        raise JobError("job.toml", "sensor.model", "glass eye", "pinhole")
    if each.name == "dies" or (each.name == "dies-once" and each.attempt == 1):
        os.kill(os.getpid(), signal.SIGKILL)
    if each.name == "leaves":
        os._exit(7)
    if each.name == "waits" and each.attempt == 1:
        each.folder.mkdir(parents=True)
        (each.folder / "pid").write_text(str(os.getpid()))
        time.sleep(600.0)
    return record(each)


def threads(each: Task) -> Record:
    """Says in its message how many threads torch would use."""
    import torch  # noqa: PLC0415

    return replace(record(each), message=str(torch.get_num_threads()))
