"""How much each unknown may change between frames: of which unknowns, and by what number."""

from collections.abc import Iterator

import jaxtyping
import pytest
import recordings
import torch
from recordings import pose
from tracked_camera import SENSOR, camera_job, generator

from torchcal.calibrate.tracker import Tracker
from torchcal.calibrate.wander import Wander
from torchcal.errors import TorchcalError
from torchcal.model.job import RangePrior
from torchcal.model.robot import load_robot


@pytest.fixture
def as_for_a_user() -> Iterator[None]:
    """Without the checks of annotations, which only the tests have."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)


@pytest.mark.usefixtures("as_for_a_user")
@pytest.mark.parametrize(
    ("drift", "words"),
    [
        ({"share": "a"}, "found 'a' for share; expected a number"),
        ({"share": None}, "found None for share; expected a number"),
        ({"blocks": {"range.scale": "a"}}, "found 'a' for range.scale; expected a number"),
        ({"blocks": {"range.scale": None}}, "found None for range.scale; expected a number"),
    ],
)
def test_a_drift_that_is_no_number_is_named(drift, words):
    job = camera_job(range=RangePrior(offset_sigma=0.01, scale_sigma=0.01))
    with pytest.raises(TorchcalError, match=words):
        Tracker.of(job, drift=Wander(**drift), generator=generator())


@pytest.mark.parametrize("name", ["nod.x", "nod.rx", "a.b.rz", "nod"])
def test_joints_may_be_called_like_axes(tmp_path, name):
    recordings.arm(tmp_path)
    file = tmp_path / "arm.urdf"
    file.write_text(file.read_text().replace('name="nod"', f'name="{name}"'))
    robot, still = load_robot(file), torch.zeros(2).double()
    job = recordings.carried(robot, SENSOR, recordings.EYE, pose(0.25, 0, 0.08, 0, 1.3, 0), [still])
    job = camera_job(robot=robot, link=job.link, joints={name: 0.1}, base=None)
    drift = Wander(blocks={f"joints.{name}": 0.02})
    assert Tracker.of(job, drift=drift, generator=generator()).drift.tolist() == [0.02]
