"""Processes that are really killed, from inside and from outside."""

import os
import signal
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import fleet_work
import pytest

from torchcal.fleet.processes import Processes
from torchcal.fleet.schedule import run_all
from torchcal.fleet.task import End, Ended, Work

pytestmark = pytest.mark.slow  # a process that loads torch takes seconds
PATIENCE = 600.0
"""s; for what takes a few on a machine with nothing else to do."""


def ends(names: Sequence[str], folder: Path, work: Work = fleet_work.work) -> dict[str, Ended]:
    """How tasks end in two processes, by name."""
    place = Processes(work, 2)
    try:
        tasks = [fleet_work.task(name, folder) for name in names]
        found = list(run_all(tasks, place, attempts=2))
    finally:
        place.close()
    assert sorted(each.task.name for each in found) == sorted(names)
    return {each.task.name: each for each in found}


@pytest.fixture(scope="module")
def mixed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ended]:
    """Good and bad tasks; each of two processes has several to do."""
    names = ["fine-1", "dies-once", "fine-2", "broken", "dies", "fine-3", "leaves", "wrong"]
    return ends(names, tmp_path_factory.mktemp("mixed"))


def test_a_task_whose_worker_was_killed_is_done_by_another(mixed):
    found = mixed["dies-once"]
    assert found.end is End.DONE
    assert found.task.attempt == 2


def test_a_task_that_kills_every_worker_is_reported_with_the_signal(mixed):
    assert mixed["dies"].end is End.KILLED
    assert mixed["dies"].task.attempt == 2
    assert mixed["dies"].message == "the worker was killed by SIGKILL"


def test_a_worker_that_leaves_is_reported_with_its_status(mixed):
    assert mixed["leaves"].end is End.KILLED
    assert mixed["leaves"].message == "the worker ended with exit status 7"


def test_the_others_are_done_meanwhile(mixed):
    assert all(mixed[f"fine-{k}"].end is End.DONE for k in (1, 2, 3))
    assert (mixed["broken"].end, mixed["wrong"].end) == (End.ERROR, End.UNREADABLE)


def test_work_is_done_in_other_processes(mixed):
    record = mixed["fine-1"].record
    assert record is not None
    assert record.message != f"process {os.getpid()}"


def test_a_worker_that_is_killed_in_the_middle_costs_one_attempt(tmp_path):
    pid = tmp_path / "waits" / "pid"

    def kill() -> None:
        until = time.monotonic() + PATIENCE
        while time.monotonic() < until and not (pid.exists() and pid.read_text()):
            time.sleep(0.05)
        os.kill(int(pid.read_text()), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    found = ends(["waits", "fine"], tmp_path)
    killer.join()
    assert [found[name].task.attempt for name in ("waits", "fine")] == [2, 1]
    assert all(each.end is End.DONE for each in found.values())


def test_a_worker_has_one_thread_and_the_driver_keeps_its_own(tmp_path):
    before = dict(os.environ)
    record = ends(["any"], tmp_path, fleet_work.threads)["any"].record
    assert record is not None
    assert record.message == "1"
    assert dict(os.environ) == before
