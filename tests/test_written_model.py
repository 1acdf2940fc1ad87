"""The written files together are the estimate: base, joints, mount and objects of one fit."""

from dataclasses import replace
from pathlib import Path

import pytest
import recordings
import torch
from recordings import EYE, pose, prior

from torchcal.calibrate import calibrate, predict
from torchcal.calibrate.decisions import PROVENANCE
from torchcal.calibrate.result import Calibration, Change
from torchcal.calibrate.result_folder import read_result
from torchcal.cli.result_files import write_results
from torchcal.display.decided import decide
from torchcal.model.robot import load_robot
from torchcal.model.world import World, load_world

UNKNOWN = ("crate", "shelf")
ATOL = 1e-6
"""m and parts of a rotation; files hold all digits."""


@pytest.fixture(scope="module")
def calibration(tmp_path_factory) -> Calibration:
    """Base, a joint and two objects of unknown pose, which stand where the model has them."""
    postures = [torch.tensor(each).double() for each in ([0.3, -0.2], [-0.4, 0.2])]
    T_world_base = pose(0.1, -0.1, -0.6, 0.0, -1.4, 0.0)
    job = recordings.carried(
        recordings.arm(tmp_path_factory.mktemp("arm")),
        recordings.sensor(beam=3),
        T_world_base,
        pose(0.5, 0.0, 0.0, 0.0, 1.4, 0.0),
        postures,
    )
    off = pose(0.01, -0.01, 0.02, 0.01, 0.0, -0.01)
    job = replace(
        job,
        T_world_base=T_world_base @ off,
        base=prior(0.03, 0.03),
        joints={"nod": 0.02},
        objects={name: prior(0.03, 0.03) for name in UNKNOWN},
    )
    return calibrate(job, generator=torch.Generator().manual_seed(0))


@pytest.fixture
def folder(calibration, tmp_path) -> Path:
    write_results(calibration, tmp_path / "out")
    return tmp_path / "out"


def world_of(file: Path) -> World:
    return load_world(file, unit=1.0, T_world_file=EYE, complete=False)


def poses_of(world: World) -> dict[str, torch.Tensor]:
    return {item.name: item.T_world_object for item in world.objects}


def test_objects_of_unknown_pose_stand_where_they_were_estimated(calibration, folder):
    assert {each.verdict for each in calibration.update.verdicts.values()} == {"agrees"}
    found = poses_of(world_of(folder / "world.glb"))
    for name in UNKNOWN:
        T = calibration.estimate.Ts_world_object[name]
        assert float((T - EYE).abs().max()) > 100 * ATOL
        torch.testing.assert_close(found[name], T, rtol=0.0, atol=ATOL)
    for name in ("room", "beam"):
        torch.testing.assert_close(found[name], EYE, rtol=0.0, atol=0.0)


def test_a_job_of_the_written_files_predicts_what_was_compared(calibration, folder):
    robot = load_robot(folder / "robot.urdf")
    job = replace(
        calibration.job,
        world=world_of(folder / "world.glb"),
        robot=robot,
        link="torchcal_sensor",
        T_world_base=EYE,
        T_link_sensor=EYE,
        base=None,
        joints={},
        objects={},
    )
    for frame, T in zip(job.frames, calibration.estimate.Ts_world_sensor, strict=True):
        assert frame.joints is not None
        written = robot.forward_kinematics(frame.joints)[robot.link_index("torchcal_sensor")]
        torch.testing.assert_close(written, T, rtol=0.0, atol=ATOL)
    for image, comparison in zip(predict(job), calibration.comparisons, strict=True):
        off = (image - comparison.predicted).abs()
        # Images are of single precision, and a pixel along an edge may show the other side.
        assert float(off.nanmedian()) < ATOL
        assert float((off > 1e-4).double().mean()) < 0.01


def test_they_can_be_put_back_one_by_one(calibration, folder):
    proposals = read_result(folder).transaction.update.proposals
    assert {each.name: each.change for each in proposals} == dict.fromkeys(UNKNOWN, Change.ADJUST)
    decide(folder, reject=["crate"])
    found = world_of(folder / "world.glb")
    torch.testing.assert_close(poses_of(found)["crate"], EYE, rtol=0.0, atol=0.0)
    T = calibration.estimate.Ts_world_object["shelf"]
    torch.testing.assert_close(poses_of(found)["shelf"], T, rtol=0.0, atol=ATOL)
    (shelf,) = (item for item in found.objects if item.name == "shelf")
    assert shelf.extras[PROVENANCE][0]["change"] == "adjust"
    decide(folder, reject=["all"])
    for T in poses_of(world_of(folder / "world.glb")).values():
        torch.testing.assert_close(T, EYE, rtol=0.0, atol=0.0)
    assert "show it where it was estimated" in (folder / "report.html").read_text(encoding="utf-8")


def test_where_nothing_was_estimated_nothing_is_adjusted(calibration):
    job = calibration.job
    compared = calibrate(job, estimate=False, generator=torch.Generator().manual_seed(0))
    assert {each.T_world_object for each in compared.update.verdicts.values()} == {None}
