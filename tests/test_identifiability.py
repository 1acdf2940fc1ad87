"""``scripts/identifiability.py`` on jobs whose images are still to be taken."""

import json
import subprocess
import sys
from pathlib import Path

import tiny_job

from torchcal.demo.calibration_jobs import job_of

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "identifiability.py"


def run(*arguments: str) -> subprocess.CompletedProcess:
    return subprocess.run(
        [sys.executable, str(SCRIPT), *arguments], capture_output=True, text=True, check=False
    )


def test_a_job_without_its_images_is_foreseen(tmp_path):
    file = tiny_job.write(
        tmp_path, tiny_job.ARM_JOB + "[unknown.joints]\nsigma_deg = 1\nsigma = 0.01\n"
    )
    for image in ("a.png", "b.npy", "mask.png"):
        (tmp_path / image).unlink()
    answer = run(str(file), "--json")
    assert answer.returncode == 0, answer.stderr
    found = json.loads(answer.stdout)
    names = [each["name"] for each in found["parameters"]]
    assert names[:3] == ["base.x", "base.y", "base.z"]
    assert [name for name in names if name.startswith("joints.")] == [
        "joints.shoulder",
        "joints.elbow",
        "joints.lift",
    ]
    assert all(0 < each["expected_sigma"] <= each["prior_sigma"] for each in found["parameters"])
    assert "next_view" in found
    words = run(str(file))
    assert words.returncode == 0
    assert "joints.elbow" in words.stdout


def test_a_mistake_in_the_job_is_one_line(tmp_path):
    file = tiny_job.write(tmp_path, tiny_job.ARM_JOB + "[unknown.object.crat]\n")
    answer = run(str(file))
    assert answer.returncode == 2
    assert "unknown.object.crat" in answer.stderr
    assert "Traceback" not in answer.stderr


def test_the_experiments_jobs_say_what_is_unknown():
    unknown = job_of("everything", 32)
    assert len(unknown.frames) == 10
    assert len(unknown.joints) == 6
    assert unknown.sensor.projection.width == 32
    assert set(job_of("objects", 32).objects) == {"workbench", "cabinet"}
    assert len(job_of("rover-sonar", 32).frames) == 20
