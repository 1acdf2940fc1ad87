"""A reader that goes away, such as ``head``, is no mistake of the job: everything is written."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import tiny_job

COMMAND = "import sys; from torchcal.cli.main import main; sys.exit(main(sys.argv[1:]))"


def run_unread(*arguments: str) -> tuple[int, str]:
    """Exit status and standard error of a command whose standard output nobody reads."""
    read, write = os.pipe()
    os.close(read)
    try:
        answer = subprocess.run(
            [sys.executable, "-c", COMMAND, *arguments],
            stdout=write,
            stderr=subprocess.PIPE,
            text=True,
            check=False,
        )
    finally:
        os.close(write)
    return answer.returncode, answer.stderr


@pytest.mark.parametrize(("how", "written"), [(["--json"], "result.json"), ([], "report.html")])
def test_calibrate_ends_quietly_with_its_own_status(tmp_path: Path, how: list[str], written: str):
    file = tiny_job.write(tmp_path, tiny_job.ARM_JOB)
    out = tmp_path / "out"
    code, said = run_unread("calibrate", str(file), "--out", str(out), "--no-estimate", *how)
    # The images are of nothing in particular, so that the answer cannot be used.
    assert (code, said) == (3, "")
    assert (out / written).exists()


def test_follow_writes_every_line(tmp_path: Path):
    file = tiny_job.write(tmp_path, tiny_job.ARM_JOB)
    out = tmp_path / "out"
    code, said = run_unread("follow", str(file), "--out", str(out), "--json")
    assert code == 3
    assert said == f"no frame was explained: torchcal check {file} names mistakes that it finds\n"
    assert len((out / "frames.jsonl").read_text(encoding="utf-8").splitlines()) == 2
