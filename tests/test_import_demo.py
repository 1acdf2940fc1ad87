"""The demo's recording as a bag, imported and calibrated: the answer of the demo's own job."""

from pathlib import Path

import pytest
import torch
from bags import KINDS
from demo_bag import PACKAGE, bag_of
from small_demo import write_small_demo

import torchcal
from torchcal.demo import recording

CLOSE = 0.001  # m, rad: as far as so few pixels tell the truth


def calibrated(job: Path) -> torchcal.Estimate:
    generator = torch.Generator().manual_seed(0)
    return torchcal.calibrate(torchcal.read_job(job), generator=generator).estimate


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, torch.Tensor]:
    folder = tmp_path_factory.mktemp("demo")
    truth = write_small_demo(folder)
    return folder / "job.toml", truth


def imported(demo: Path, kind: str, folder: Path) -> Path:
    out = folder / "out"
    out.mkdir()
    packages = {PACKAGE: demo.parent / "arm"}
    source = bag_of(demo, kind, folder)
    return torchcal.import_recording(source, out, packages=packages, like=demo).job


@pytest.mark.parametrize("kind", KINDS)
def test_the_imported_job_is_the_demos(demo, kind: str, tmp_path: Path):
    own, found = (torchcal.read_job(file) for file in (demo[0], imported(demo[0], kind, tmp_path)))
    assert found.sensor == own.sensor
    assert found.link == recording.LINK
    assert len(found.frames) == len(own.frames)
    for one, other in zip(own.frames, found.frames, strict=True):
        torch.testing.assert_close(other.joints, one.joints, rtol=0, atol=0)
        torch.testing.assert_close(
            other.image.range, one.image.range, rtol=0, atol=0, equal_nan=True
        )
    assert own.robot is not None
    assert found.robot is not None
    assert found.robot.link_meshes.keys() == own.robot.link_meshes.keys()
    for name, mesh in own.robot.link_meshes.items():
        assert (found.robot.link_meshes[name].triangles == mesh.triangles).all()


@pytest.mark.slow
def test_the_imported_job_has_the_answer_of_the_demos(demo, tmp_path: Path):
    file, T_world_base = demo
    own, found = calibrated(file), calibrated(imported(file, "sqlite3", tmp_path))
    assert found.status == own.status == torchcal.Status.CONVERGED
    torch.testing.assert_close(found.T_world_base, own.T_world_base, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.covariance, own.covariance, rtol=1e-9, atol=0)
    torch.testing.assert_close(found.T_world_base, T_world_base, rtol=0, atol=CLOSE)
