"""A real recording of a cylinder by a camera on a flange, as the job that a script makes of it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from torchcal.calibrate.pipeline import calibrate
from torchcal.calibrate.result import Calibration, Status
from torchcal.geometry import se3
from torchcal.geometry.projection import pixel_grid
from torchcal.model.job import Frame
from torchcal.model.read_job import read_job

SCRIPT = Path(__file__).resolve().parents[1] / "scripts" / "cylinder_job.py"
DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "reghec_jaka" / "Cylinder"
VIEWS = ("1", "4", "7", "9")
"""They look from all sides."""

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> dict:
    """What the script says of the job that it wrote."""
    if not DATA.is_dir():
        pytest.skip(f"needs the real recording {DATA}")
    out = tmp_path_factory.mktemp("cylinder") / "job"
    command = [sys.executable, str(SCRIPT), str(DATA), "--out", str(out), "--focal", "150"]
    answer = subprocess.run(
        [*command, "--views", *VIEWS], capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stderr
    return json.loads(answer.stdout)


@pytest.fixture(scope="module")
def calibration(written) -> Calibration:
    return calibrate(read_job(Path(written["job"])), generator=torch.Generator().manual_seed(0))


def side_points(calibration: Calibration, frame: Frame, T_world_sensor: Tensor) -> Tensor:
    """What a frame shows of the cylinder's side, in the robot's base (m)."""
    lens, image = calibration.job.sensor.projection, frame.image
    rays = lens.rays(*pixel_grid(lens, dtype=torch.float64, device=torch.device("cpu")))
    points = (image.range[..., None] * rays)[image.usable & image.range.isfinite()]
    return se3.transform(T_world_sensor, points)


@pytest.fixture(scope="module")
def sides(calibration) -> list[Tensor]:
    """Of every view."""
    poses = calibration.estimate.Ts_world_sensor
    return [
        side_points(calibration, frame, T)
        for frame, T in zip(calibration.job.frames, poses, strict=True)
    ]


def test_every_view_has_the_same_radius(written):
    np.testing.assert_allclose(written["radii_m"], written["radius_m"], atol=0.0003)
    assert max(written["noise_m"]) < 0.0001


def test_the_slide_along_the_axis_and_the_turn_about_it_are_named(calibration):
    assert calibration.estimate.status is Status.UNOBSERVABLE
    # Four views leave more open than all nine, of which nothing but these two is said.
    assert {direction.words for direction in calibration.estimate.unobservable} >= {
        "a shift of object cylinder along z cannot be told from these images",
        "a turn of object cylinder about z cannot be told from these images",
    }


def test_all_views_lie_on_one_cylinder(calibration, written, sides):
    T_cylinder_world = se3.inverse(calibration.estimate.Ts_world_object["cylinder"])
    for points in sides:
        radius = se3.transform(T_cylinder_world, points)[:, :2].norm(dim=1)
        off = (radius - written["radius_m"]).abs()
        assert float(off.median()) < 0.001
