"""Processes of this machine, each with a pipe: one that is killed costs one attempt at one task.

An executor of the standard library would be broken as a whole by a worker that is killed.
"""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import get_context, parent_process
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from threading import Thread

from torchcal.fleet.task import End, Ended, Task, Work, attempt

ONE_THREAD = {
    f"{library}_NUM_THREADS": "1" for library in ("OMP", "MKL", "OPENBLAS", "NUMBA", "VECLIB")
}
"""The environment of a worker: libraries read it once, when they are loaded."""
PATIENCE = 5.0
"""Seconds that a worker has to end when it is told to."""


@dataclass(frozen=True, kw_only=True, slots=True, eq=False)
class _Worker:
    process: SpawnProcess
    pipe: Connection

    def told(self) -> str:
        """Why it ended."""
        self.process.join()
        code = self.process.exitcode or 0
        if code < 0:
            return f"the worker was killed by {signal.Signals(-code).name}"
        return f"the worker ended with exit status {code}"


class Processes:
    """A number of processes of one thread each; those that die are replaced when needed."""

    def __init__(self, work: Work, count: int):
        self.capacity = count
        self._work = work
        self._idle: list[_Worker] = []
        self._busy: dict[_Worker, Task] = {}

    def begin(self, task: Task) -> None:
        """Gives the task to a worker that waits, or to a new one."""
        worker = self._waiting_worker() or _start(self._work)
        self._busy[worker] = task
        # One that dies in this moment is found dead by whoever waits for it.
        with suppress(OSError):
            worker.pipe.send(task)

    def next_ended(self) -> Ended:
        """Waits for the first worker that answers or dies."""
        ready = wait([worker.pipe for worker in self._busy])[0]
        worker = next(each for each in self._busy if each.pipe is ready)
        task = self._busy.pop(worker)
        try:
            ended: Ended = worker.pipe.recv()
        except (EOFError, OSError):
            worker.pipe.close()
            return Ended(task=task, end=End.KILLED, message=worker.told())
        self._idle.append(worker)
        return ended

    def close(self) -> None:
        """Lets workers that wait end, and ends the others."""
        for worker in self._busy:
            worker.process.kill()
        for worker in (*self._idle, *self._busy):
            worker.pipe.close()
        for worker in (*self._idle, *self._busy):
            worker.process.join(PATIENCE)
            worker.process.kill()
        self._idle.clear()
        self._busy.clear()

    def _waiting_worker(self) -> _Worker | None:
        while self._idle:
            worker = self._idle.pop()
            if worker.process.is_alive():
                return worker
            worker.pipe.close()
        return None


def _start(work: Work) -> _Worker:
    # Not a fork: a copy of a process that runs torch's threads may hang.
    context = get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, work), daemon=True)
    with _environment(ONE_THREAD):
        process.start()
    theirs.close()
    return _Worker(process=process, pipe=ours)


@contextmanager
def _environment(values: dict[str, str]) -> Iterator[None]:
    """Values that processes started meanwhile find in their environment."""
    before = {key: os.environ.get(key) for key in values}
    os.environ.update(values)
    try:
        yield
    finally:
        for key, value in before.items():
            if value is None:
                del os.environ[key]
            else:
                os.environ[key] = value


def _serve(pipe: Connection, work: Work) -> None:
    """What a worker does: tasks, until the pipe is closed."""
    # Ctrl-C reaches every process of the terminal; what follows of it is the driver's to decide.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_driver, daemon=True).start()
    with suppress(EOFError, OSError):
        while True:
            pipe.send(attempt(work, pipe.recv()))


def _end_with_driver() -> None:
    """Ends this process at once when the driver is gone: the next driver may do the same task."""
    driver = parent_process()
    if driver is not None:
        wait([driver.sentinel])
        os._exit(1)
