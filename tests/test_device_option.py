"""The commands on a GPU: what a person asks for with ``--device``, or gets where there is one."""

import json
from pathlib import Path

import numpy as np
import pytest
import recordings
import torch
from numpy.testing import assert_allclose

from torchcal.calibrate.followed import Followed
from torchcal.calibrate.result import PixelClass
from torchcal.cli.main import main
from torchcal.display.view.follow import FollowSource
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole
from torchcal.model.read_job import read_recording
from torchcal.model.world import write_world

JOB = """\
[world]
model = "room.glb"

[robot]
urdf = "arm.urdf"
base = { xyz = [-0.3, 0.1, -0.5] }

[sensor]
link = "tool"
mount = { xyz = [0.3, 0.0, 0.1], rpy_deg = [0, 20, 0] }
model = "pinhole"
width = 24
height = 18
fx = 20.6
fy = 20.2
cx = 11.7
cy = 8.9
range = [0.1, 20.0]
sigma = 0.005
drift = 0

[unknown.base]
position_sigma = 0.05
rotation_sigma_deg = 2.0
"""
POSTURES = ((0.2, -0.3), (0.25, -0.28))


@pytest.fixture
def job(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, device: torch.device) -> Path:
    """A robot's job on a machine whose default device is a GPU."""
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    meshes = {name: recordings.room()[name] for name in ("room", "crate")}
    monkeypatch.setattr(recordings, "room", lambda: dict(meshes))
    projection = Pinhole(width=24, height=18, fx=20.6, fy=20.2, cx=11.7, cy=8.9)
    base = se3.from_xyz_rpy(recordings.twist(-0.3, 0.1, -0.5), recordings.twist(0, 0, 0))
    mount = se3.from_xyz_rpy(
        recordings.twist(0.3, 0.0, 0.1), recordings.twist(0.0, 20.0, 0.0).deg2rad()
    )
    real = recordings.carried(
        recordings.arm(tmp_path),
        recordings.sensor(projection),
        base,
        mount,
        [recordings.twist(*posture) for posture in POSTURES],
    )
    write_world(recordings.world_of(recordings.room()), tmp_path / "room.glb")
    frames = ""
    for frame, (turn, nod) in zip(real.frames, POSTURES, strict=True):
        np.save(tmp_path / f"{frame.image.name}.npy", frame.image.range.numpy())
        joints = f"joints = {{ turn = {turn}, nod = {nod} }}"
        frames += f'\n[[frame]]\ndepth = "{frame.image.name}.npy"\n{joints}\n'
    (tmp_path / "job.toml").write_text(JOB + frames)
    return tmp_path / "job.toml"


def run(command: str, job: Path, *options: str) -> Path:
    """What a command writes; its words are not looked at."""
    out = job.parent / "-".join([command, *options]).replace("--", "")
    assert main([command, str(job), "--out", str(out), *options]) == 0
    return out


def lines(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]


def test_a_recording_is_followed_and_viewed(job, device):
    away, here = run("follow", job), run("follow", job, "--device", "cpu")
    for found, expected in zip(lines(away), lines(here), strict=True):
        assert found["status"] == expected["status"] == "tracking"
        # Images are in single precision.
        assert_allclose(found["T_world_sensor"], expected["T_world_sensor"], atol=1e-5)
        assert_allclose(found["covariance"], expected["covariance"], atol=1e-7)
    followed = Followed.of(read_recording(job, device=device))
    shown = FollowSource(followed, lambda: away / "frames.jsonl").latest(None)
    for k, place in enumerate(shown.frames):
        assert_allclose(place.T_world_sensor, lines(away)[k]["T_world_sensor"], atol=1e-6)
        agrees = shown.comparisons[k].label == PixelClass.AGREES
        assert float(agrees.double().mean()) > 0.5


@pytest.mark.slow
def test_a_comparison_is_written(job):
    options = ("--no-estimate",)
    away = run("calibrate", job, *options)
    here = run("calibrate", job, *options, "--device", "cpu")
    found, expected = (json.loads((out / "result.json").read_text()) for out in (away, here))
    assert found["frames"] == expected["frames"]
    for name in ("frame-0", "frame-1"):
        both = [np.load(out / "frames" / f"{name}.npz")["predicted"] for out in (away, here)]
        assert_allclose(*both, atol=1e-5)
