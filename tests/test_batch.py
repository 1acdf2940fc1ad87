"""``torchcal batch``: every job is accounted for, finished ones are left alone."""

import csv
import json
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import fleet_jobs
import pytest
from filelock import FileLock

from torchcal.calibrate import calibrate
from torchcal.cli import batch, batch_job
from torchcal.cli.main import main
from torchcal.cli.result_files import as_json, result_dict
from torchcal.fleet import table


class Library:
    """The library with hands that write no pictures, and a count of what was calibrated."""

    def __init__(self) -> None:
        self.done: list[str] = []
        self.fail: Callable[[str], None] = lambda name: None

    def calibrate(self, job, *, generator):
        name = job.file.parent.name
        self.done.append(name)
        self.fail(name)
        return calibrate(job, generator=generator)

    @staticmethod
    def write_results(calibration, folder):
        (folder / "result.json").write_text(as_json(result_dict(calibration)))


@pytest.fixture
def library(monkeypatch):
    found = Library()
    monkeypatch.setattr(batch_job, "calibrate", found.calibrate)
    monkeypatch.setattr(batch_job, "write_results", found.write_results)
    return found


@pytest.fixture
def jobs(tmp_path) -> Path:
    """Three jobs with usable answers."""
    for name in ("a", "b", "c"):
        fleet_jobs.write_job(tmp_path / "jobs" / name)
    return tmp_path / "jobs"


def run(jobs: Path, *more: str) -> int:
    return main(["batch", str(jobs), "--out", str(jobs.parent / "out"), *more])


def rows(jobs: Path) -> dict[str, dict[str, str]]:
    """The table, by job; fails where a job has two rows."""
    text = (jobs.parent / "out" / "fleet.csv").read_text(encoding="utf-8")
    listed = list(csv.DictReader(text.splitlines()))
    found = {row["job"]: row for row in listed}
    assert len(found) == len(listed)
    return found


def test_every_job_gets_its_result_and_its_row(library, jobs):
    assert run(jobs) == 0
    assert [(row["job"], row["status"]) for row in rows(jobs).values()] == [
        (name, "converged") for name in "abc"
    ]
    for name in "abc":
        result = json.loads((jobs.parent / "out" / name / "result.json").read_text())
        assert result["status"] == "converged"
    assert "3 of 3 answers can be used" in (jobs.parent / "out" / "fleet.html").read_text()


def test_finished_jobs_are_not_done_again(library, jobs, capsys):
    run(jobs)
    before = {name: (jobs.parent / "out" / name / "result.json").stat() for name in "abc"}
    assert run(jobs) == 0
    assert library.done == ["a", "b", "c"]
    after = {name: (jobs.parent / "out" / name / "result.json").stat() for name in "abc"}
    assert {n: s.st_ino for n, s in after.items()} == {n: s.st_ino for n, s in before.items()}
    assert "3 kept from an earlier run: the same job, files and seed" in capsys.readouterr().out
    assert set(rows(jobs)) == set("abc")


def change_job_file(job: Path) -> None:
    job.write_text(job.read_text().replace("sigma = 0.01", "sigma = 0.011"))


def change_image(job: Path) -> None:
    fleet_jobs.date(job, 1e9)


@pytest.mark.parametrize("change", [change_job_file, change_image])
def test_a_job_that_changed_is_done_again_and_this_is_said(library, jobs, capsys, change):
    run(jobs)
    change(jobs / "b" / "job.toml")
    assert run(jobs) == 0
    assert library.done == ["a", "b", "c", "b"]
    assert "1 done again: the job" in capsys.readouterr().out


def test_another_seed_is_another_answer(library, jobs):
    run(jobs)
    run(jobs, "--seed", "1")
    assert library.done == [*"abc", *"abc"]


def test_jobs_that_are_new_are_added(library, jobs):
    run(jobs)
    fleet_jobs.write_job(jobs / "0-first")
    run(jobs)
    assert library.done == ["a", "b", "c", "0-first"]
    assert list(rows(jobs)) == ["0-first", "a", "b", "c"]


def test_a_result_that_batch_did_not_write_is_no_finished_job(library, jobs):
    run(jobs)
    (jobs.parent / "out" / "b" / "batch.json").write_text("{")
    assert run(jobs) == 0
    assert library.done == ["a", "b", "c", "b"]


def test_a_job_that_fails_once_is_tried_again(library, jobs):
    def fail(name: str) -> None:
        if library.done == ["a"]:
            raise RuntimeError("out of luck")

    library.fail = fail
    assert run(jobs) == 0
    assert library.done == ["a", "b", "c", "a"]
    assert [row["attempts"] for row in rows(jobs).values()] == ["2", "1", "1"]


def test_a_job_that_always_fails_is_reported_and_the_others_are_done(library, jobs, capsys):
    def fail(name: str) -> None:
        if name == "a":
            raise RuntimeError("out of luck")

    library.fail = fail
    assert run(jobs, "--attempts", "2") == 3
    assert [row["status"] for row in rows(jobs).values()] == ["error", "converged", "converged"]
    assert "a: error after 2 attempts: RuntimeError: out of luck" in capsys.readouterr().out
    assert not (jobs.parent / "out" / "a").exists()
    library.fail = lambda name: None
    assert run(jobs) == 0
    assert [row["status"] for row in rows(jobs).values()] == ["converged"] * 3


def test_a_job_that_cannot_be_read_does_not_stop_the_others(library, jobs):
    fleet_jobs.spoil(jobs / "b" / "job.toml")
    assert run(jobs) == 3
    found = rows(jobs)
    assert found["b"]["status"] == "unreadable"
    assert "glass eye" in found["b"]["message"]
    assert found["b"]["attempts"] == "1"
    assert found["c"]["status"] == "converged"


def test_if_no_job_can_be_read_the_exit_status_says_so(library, jobs):
    for name in "abc":
        fleet_jobs.spoil(jobs / name / "job.toml")
    assert run(jobs) == 2
    assert set(rows(jobs)) == set("abc")


def test_an_answer_that_cannot_be_used_is_finished_but_not_a_success(library, jobs):
    fleet_jobs.write_job(jobs / "far", wall=3.5)
    assert run(jobs) == 3
    assert rows(jobs)["far"]["status"] == "failed"
    assert run(jobs) == 3
    assert library.done.count("far") == 1


def test_json_is_the_table_and_nothing_else(library, jobs, capsys):
    run(jobs, "--json")
    listed = json.loads(capsys.readouterr().out)["jobs"]
    assert [(row["job"], row["usable"], row["attempts"]) for row in listed] == [
        (name, True, 1) for name in "abc"
    ]


def test_parquet_holds_the_same_table_with_types(library, jobs):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
    fleet_jobs.spoil(jobs / "b" / "job.toml")
    run(jobs)
    read = parquet.read_table(jobs.parent / "out" / "fleet.parquet").to_pydict()
    assert read["job"] == ["a", "b", "c"]
    assert read["usable"] == [True, False, True]
    assert read["frames"] == [1, None, 1]
    written = [float(row["seconds"] or 0.0) for row in rows(jobs).values()]
    assert [seconds or 0.0 for seconds in read["seconds"]] == written


def test_without_pyarrow_there_is_csv_and_it_is_said(library, jobs, capsys, monkeypatch):
    def absent(name: str):
        raise ImportError(name)

    (jobs.parent / "out").mkdir()
    stale = jobs.parent / "out" / "fleet.parquet"
    stale.write_bytes(b"old")
    monkeypatch.setattr(table, "import_module", absent)
    assert run(jobs) == 0
    assert not stale.exists()
    assert "needs pyarrow" in capsys.readouterr().out
    assert set(rows(jobs)) == set("abc")


def test_interrupted_it_keeps_what_is_finished_and_goes_on_later(library, jobs, capsys):
    def interrupt(name: str) -> None:
        if name == "b":
            raise KeyboardInterrupt

    library.fail = interrupt
    assert run(jobs) == 130
    assert [row["status"] for row in rows(jobs).values()] == ["converged", "not run", "not run"]
    library.fail = lambda name: None
    assert run(jobs) == 0
    assert library.done == ["a", "b", "b", "c"]


def test_what_a_killed_run_left_half_written_goes(library, jobs):
    out = jobs.parent / "out"
    (out / ".a.partial-0123abcd" / "hybrid").mkdir(parents=True)
    (out / ".mine.partial-0123abcd").mkdir()
    run(jobs)
    assert sorted(path.name for path in out.iterdir() if path.is_dir()) == [
        ".mine.partial-0123abcd",
        *"abc",
    ]


def test_an_old_result_comes_back_where_its_successor_was_cut_off(library, jobs):
    run(jobs)
    out = jobs.parent / "out"
    (out / "a").rename(out / ".a.old-0123abcd")
    assert run(jobs) == 0
    assert library.done == ["a", "b", "c"]
    assert (out / "a" / "result.json").exists()


def test_two_batches_do_not_write_into_one_folder(library, jobs, capsys):
    (jobs.parent / "out").mkdir()
    with FileLock(jobs.parent / "out" / batch.LOCK):
        assert run(jobs) == 2
    assert "another batch" in capsys.readouterr().err
    assert library.done == []


@pytest.mark.parametrize("option", ["--workers", "--attempts"])
def test_numbers_below_one_are_refused(jobs, capsys, option):
    assert run(jobs, option, "0") == 2
    assert f"{option}: found 0; expected 1 or more" in capsys.readouterr().err


def test_without_ray_it_says_what_to_install(jobs, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert run(jobs, "--ray", "local") == 2
    assert "torchcal[fleet]" in capsys.readouterr().err


def test_a_cluster_that_is_not_there_is_one_line(jobs, capsys):
    pytest.importorskip("ray", reason="needs Ray (the fleet extra)")
    assert run(jobs, "--ray", "127.0.0.1:1") == 2
    told = capsys.readouterr().err
    assert told.startswith("error: --ray 127.0.0.1:1: found ")
    assert told.count("\n") == 1


def test_results_are_not_written_over_what_a_job_needs(jobs, capsys):
    assert main(["batch", str(jobs), "--out", str(jobs)]) == 2
    assert "expected another folder" in capsys.readouterr().err
    assert (jobs / "a" / "job.toml").exists()


def test_a_job_whose_worker_died_after_the_last_byte_is_not_done_twice(library, jobs):
    run(jobs)
    tasks = {}

    def kept(task):
        tasks[task.name] = task
        return batch_job.run_job(replace(task, attempt=2))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(batch, "run_job", kept)
        patch.setattr(batch, "finished", lambda task: None)
        assert run(jobs) == 0
    assert set(tasks) == set("abc")
    assert library.done == ["a", "b", "c"]
