"""The poses of one image by several programs: what the table says of them."""

import sys
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
import trimesh
from torch import Tensor

from torchcal.demo.range_trials import draw_trial, range_sensor, with_start
from torchcal.geometry import se3
from torchcal.geometry.projection import Pinhole

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


@pytest.fixture
def localise(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The benchmark's module, without Open3D."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    monkeypatch.setitem(sys.modules, "open3d", None)
    return import_module("benchmarks.localise")


def trials(count: int) -> list[Any]:
    drawn = (draw_trial(0, number, offset=None, sensor=range_sensor(8)) for number in range(count))
    return [with_start(trial, 0, number, (0.01, 0.02)) for number, trial in enumerate(drawn)]


def answers(localise: ModuleType, T_start_answer: Tensor) -> Any:
    def answer(_: Tensor, start: Tensor | None) -> Tensor:
        assert start is not None
        return start @ T_start_answer

    return localise.Program(name="answers", localise=answer, absent=None)


def test_errors_are_those_of_the_answers(localise: Any):
    (row,) = localise.compare([answers(localise, torch.eye(4).double())], trials(3))
    assert row.cells == {
        "found": "3 of 3",
        "position rms": "10.00 mm",
        "rotation rms": "20.00 mrad",
    }
    assert row.seconds > 0.0


def test_a_pose_that_is_far_off_is_not_found(localise: Any):
    far = se3.exp(torch.tensor([0.5, 0.0, 0.0, 0.0, 0.0, 0.0], dtype=torch.float64))
    (row,) = localise.compare([answers(localise, far)], trials(2))
    assert row.cells == {"found": "0 of 2"}


def test_a_program_that_is_not_installed_has_a_row_that_says_so(localise: Any):
    ready = localise.prepared({"ICP": localise.open3d_icp}, trimesh.creation.box())
    (row,) = localise.compare(ready, trials(1))
    assert row.program.startswith("ICP: missing")
    assert row.seconds is None


def test_all_starts_share_an_image(localise: Any):
    drawn = localise.draw(0, 0)
    assert set(drawn) == set(localise.STARTS)
    images = [trial.range for trial in drawn.values()]
    assert all(image is images[0] for image in images)
    assert drawn["none"].start is None


def test_points_of_blocks_are_their_means(localise: Any):
    registration = import_module("benchmarks.registration")
    block, image_points = registration.BLOCK, registration.image_points
    sensor = range_sensor(16)
    image = torch.full((16, 16), 2.0, dtype=torch.float64)
    image[0, 0] = torch.nan
    points = image_points(image, sensor)
    assert len(points) == (16 // block) ** 2 - 1
    assert (points[:, 2] == 2.0).all()
    # The last block's middle is half a block from the image's border.
    assert isinstance(sensor.projection, Pinhole)
    x = 2.0 * (8.0 - 0.5 * block) / sensor.projection.fx
    assert points[-1].tolist() == pytest.approx([x, x, 2.0])
