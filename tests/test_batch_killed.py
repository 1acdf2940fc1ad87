"""Batches of which something is really killed: the driver, a worker, a worker of Ray."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

import fleet_jobs
import pytest

from torchcal.cli.main import main
from torchcal.fleet.ledger import RESULT_FILE

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not Path("/proc/self/environ").exists(), reason="needs /proc"),
]
PROGRAM = "import sys; from torchcal.cli.main import main; sys.exit(main())"
PATIENCE = 600.0
"""s; for what takes ten on a machine with nothing else to do."""
NAMES = [f"job-{k}" for k in range(6)]


@pytest.fixture
def jobs(tmp_path) -> Path:
    for name in NAMES:
        fleet_jobs.write_job(tmp_path / "jobs" / name)
    return tmp_path / "jobs"


class Running:
    """A batch in a process of its own, whose descendants are known by their environment."""

    def __init__(self, jobs: Path, *options: str):
        self.out = jobs.parent / "out"
        self.mark = f"TORCHCAL_TEST={jobs}"
        key, value = self.mark.split("=", 1)
        self.process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM, "batch", str(jobs), "--out", str(self.out), *options],
            env={**os.environ, key: value},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )

    def descendants(self) -> dict[int, str]:
        """The command lines of all other processes of this batch that are alive."""
        found = {}
        for folder in Path("/proc").glob("[0-9]*"):
            try:
                if self.mark.encode() in (folder / "environ").read_bytes().split(b"\0"):
                    found[int(folder.name)] = (folder / "cmdline").read_text().replace("\0", " ")
            except OSError:
                continue
        found.pop(self.process.pid, None)
        return found

    def results(self) -> set[str]:
        """The jobs that are finished."""
        return {file.parent.name for file in self.out.glob(f"*/{RESULT_FILE}")}

    def until(self, condition: Callable[[], bool]) -> None:
        """Waits for something to happen while the batch runs."""
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, "waited in vain"
            time.sleep(0.05)

    def ended(self) -> str:
        """What it said in all, once it has ended by itself with exit status 0."""
        said, _ = self.process.communicate(timeout=PATIENCE)
        assert self.process.returncode == 0, said
        return said


@contextmanager
def running(jobs: Path, *options: str) -> Iterator[Running]:
    batch = Running(jobs, *options)
    try:
        yield batch
    finally:
        batch.process.kill()
        batch.process.communicate()


def table(jobs: Path) -> list[dict[str, str]]:
    text = (jobs.parent / "out" / "fleet.csv").read_text(encoding="utf-8")
    return list(csv.DictReader(text.splitlines()))


def kill_while_it_writes(batch: Running, is_worker: Callable[[str], bool]) -> None:
    """Kills one of two workers when both are in the middle of a job, which stopping them proves."""

    def tried() -> bool:
        workers = [pid for pid, words in batch.descendants().items() if is_worker(words)]
        for pid in workers:
            os.kill(pid, signal.SIGSTOP)
        writing = len(workers) == len(list(batch.out.glob(".*.partial-*"))) == 2
        if writing:
            os.kill(workers.pop(), signal.SIGKILL)
        for pid in workers:
            os.kill(pid, signal.SIGCONT)
        return writing

    batch.until(tried)


def test_a_killed_driver_takes_its_workers_along_and_the_next_one_goes_on(jobs):
    with running(jobs, "--workers", "2") as batch:
        batch.until(lambda: bool(batch.results()))
        batch.process.send_signal(signal.SIGKILL)
        batch.process.wait()
        batch.until(lambda: not batch.descendants())
        finished = batch.results()
        before = {name: (batch.out / name).stat().st_ino for name in finished}
    assert finished
    assert finished < set(NAMES)
    assert main(["batch", str(jobs), "--out", str(batch.out)]) == 0
    assert {name: (batch.out / name).stat().st_ino for name in finished} == before
    assert [row["job"] for row in table(jobs)] == NAMES
    assert sorted(path.name for path in batch.out.iterdir() if path.is_dir()) == NAMES


def test_a_killed_worker_costs_one_attempt_at_one_job(jobs):
    with running(jobs, "--workers", "2") as batch:
        kill_while_it_writes(batch, lambda words: "spawn_main" in words)
        batch.ended()
    assert sorted(row["attempts"] for row in table(jobs)) == ["1"] * 5 + ["2"]
    assert [row["job"] for row in table(jobs)] == NAMES
    assert all(row["status"] == "converged" for row in table(jobs))


@pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray (the fleet extra)")
def test_a_killed_worker_of_ray_costs_one_attempt_at_one_job(jobs):
    with running(jobs, "--ray", "local", "--workers", "2") as batch:
        kill_while_it_writes(batch, lambda words: words.startswith("ray::attempt"))
        batch.ended()
        batch.until(lambda: not batch.descendants())
    assert sorted(row["attempts"] for row in table(jobs)) == ["1"] * 5 + ["2"]
    assert [row["job"] for row in table(jobs)] == NAMES
    records = [json.loads((batch.out / name / "batch.json").read_text()) for name in NAMES]
    assert all(record["status"] == "converged" for record in records)
