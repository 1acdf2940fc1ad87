"""What is left of a result when a run is killed or the disk is full: the old one, whole."""

import os
import random
import resource
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest
import tiny_job

from torchcal.cli import output
from torchcal.cli.main import main
from torchcal.cli.output import replaced_folder

FILES = ("result.json", "report.html", "robot.urdf", "world.glb")


def write_results_for_ever(folder: Path) -> None:
    """Replaces a result again and again; the files of one result hold the same word."""
    for count in range(10**9):
        with replaced_folder(folder) as partial:
            for name in FILES:
                (partial / name).write_text(f"{count}")


def killed_while_writing(folder: Path, seconds: float) -> None:
    child = os.fork()
    if child == 0:
        write_results_for_ever(folder)
    time.sleep(seconds)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)


@contextmanager
def files_of_at_most(size: int) -> Iterator[None]:
    """The system refuses to make any file longer, as it does on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that can be forked")
def test_a_run_killed_at_any_moment_leaves_a_whole_result(tmp_path):
    moments = random.Random(0)
    folder = tmp_path / "result"
    with replaced_folder(folder) as partial:
        for name in FILES:
            (partial / name).write_text("before")
    seen = set()
    for _ in range(20):
        killed_while_writing(folder, moments.uniform(0.0, 0.1))
        seen.add((folder / FILES[0]).read_text())
        assert len({(folder / name).read_text() for name in FILES}) == 1
    assert len(seen) > 2


def test_the_next_run_clears_what_killed_runs_left(tmp_path):
    folder, left = tmp_path / "result", tmp_path / ".result.partial-0123abcd"
    (left / "hybrid").mkdir(parents=True)
    (tmp_path / ".other.partial-0123abcd").mkdir()
    with replaced_folder(folder):
        assert not left.exists()
    assert sorted(each.name for each in tmp_path.iterdir()) == [".other.partial-0123abcd", "result"]


def test_what_another_run_is_writing_stays(tmp_path):
    with replaced_folder(tmp_path / "result") as first:
        (first / "result.json").write_text("first")
        with replaced_folder(tmp_path / "result") as second:
            (second / "result.json").write_text("second")
        assert (first / "result.json").read_text() == "first"
    assert (tmp_path / "result" / "result.json").read_text() == "first"


def test_an_old_result_that_was_put_aside_comes_back_before_it_is_replaced(tmp_path):
    old = tmp_path / ".result.old-0123abcd"
    old.mkdir()
    (old / "result.json").write_text("before")
    with suppress(KeyError), replaced_folder(tmp_path / "result"):
        raise KeyError("the run fails")
    assert (tmp_path / "result" / "result.json").read_text() == "before"


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs processes that can be forked")
def test_killed_runs_leave_at_most_one_folder_beside_the_result(tmp_path):
    for _ in range(5):
        killed_while_writing(tmp_path / "result", 0.05)
        assert len(list(tmp_path.glob(".result.partial-*"))) <= 1


def test_a_system_without_exchange_replaces_by_two_renames(tmp_path, monkeypatch):
    monkeypatch.setattr(output, "_exchanged", lambda one, other: False)
    for word in ("before", "after"):
        with replaced_folder(tmp_path / "result") as partial:
            (partial / "result.json").write_text(word)
    assert (tmp_path / "result" / "result.json").read_text() == "after"
    assert [path.name for path in tmp_path.iterdir()] == ["result"]


def test_a_full_disk_is_an_error_and_leaves_the_old_result(tmp_path, capsys):
    (tmp_path / "job").mkdir()
    job = tiny_job.write(tmp_path / "job", tiny_job.ARM_JOB)
    command = ["render", str(job), "--out", str(tmp_path / "seen")]
    assert main(command) == 0
    before = {path: path.read_bytes() for path in (tmp_path / "seen").rglob("*.*")}
    with files_of_at_most(200):
        assert main(command) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert "File too large" in error
    assert str(tmp_path / "seen") in error
    assert {path: path.read_bytes() for path in (tmp_path / "seen").rglob("*.*")} == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["job", "seen"]
