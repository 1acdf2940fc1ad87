"""Pipes and devices under the names of files: refused before they are opened, for ever."""

import os
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import pytest
import tiny_job
import trimesh
from fleet_jobs import write_job
from trimesh.exchange.gltf import export_gltf

from torchcal.cli.main import main
from torchcal.errors import JobError
from torchcal.model.meshes import read_scene
from torchcal.model.read_job import read_job
from torchcal.model.recordings.import_recording import import_recording

PIPE = "a named pipe, not a regular file"


def _too_long(_number: int, _frame: FrameType | None) -> None:
    raise TimeoutError("something waits for the other end of a pipe")


@pytest.fixture(autouse=True)
def no_waiting() -> Iterator[None]:
    """A reader that hangs fails after 20 s instead."""
    before = signal.signal(signal.SIGALRM, _too_long)
    signal.alarm(20)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def piped(file: Path) -> Path:
    file.unlink(missing_ok=True)
    os.mkfifo(file)
    return file


@pytest.fixture
def job(tmp_path: Path) -> Path:
    tiny_job.write_files(tmp_path)
    file = tmp_path / "job.toml"
    file.write_text(tiny_job.ARM_JOB)
    return file


@pytest.mark.parametrize("name", ["a.png", "mask.png", "b.npy", "cell.glb", "arm.urdf"])
def test_what_a_job_names_must_be_a_regular_file(job: Path, name: str):
    piped(job.parent / name)
    with pytest.raises(JobError, match=f'"{name}", {PIPE}'):
        read_job(job)


@pytest.mark.parametrize("make", [piped, lambda _: Path("/dev/zero")])
def test_a_job_must_be_a_regular_file(tmp_path: Path, make: Callable[[Path], Path]):
    with pytest.raises(JobError, match=r"found a .*, not a regular file; expected a regular file"):
        read_job(make(tmp_path / "job.toml"))


def test_a_mesh_of_a_robot_must_be_a_regular_file(job: Path):
    piped(job.parent / "arm.stl")
    urdf = job.parent / "arm.urdf"
    mesh = '<visual><geometry><mesh filename="arm.stl"/></geometry></visual></link>'
    urdf.write_text(urdf.read_text().replace("</link>", f"{mesh}", 1))
    with pytest.raises(JobError, match=rf"found arm\.stl, {PIPE}"):
        read_job(job)


def test_what_a_mesh_names_must_be_regular_files(tmp_path: Path):
    scene = trimesh.Scene(trimesh.creation.box((1.0, 1.0, 1.0)))
    for name, data in export_gltf(scene).items():
        (tmp_path / name).write_bytes(data)
    buffer = piped(next(tmp_path.glob("*.bin")))
    with pytest.raises(JobError, match=f"{buffer.name} is {PIPE}"):
        read_scene(tmp_path / "model.gltf")
    with pytest.raises(JobError, match=rf"found {buffer.name}, {PIPE}"):
        read_scene(buffer)


def test_a_batch_tells_of_a_pipe_and_does_the_other_jobs(tmp_path: Path, capsys):
    write_job(tmp_path / "jobs" / "one")
    (tmp_path / "jobs" / "two").mkdir()
    piped(tmp_path / "jobs" / "two" / "job.toml")
    assert main(["batch", str(tmp_path / "jobs"), "--out", str(tmp_path / "out")]) == 3
    printed = capsys.readouterr().out
    assert "1 unreadable" in printed
    assert PIPE in printed


@pytest.mark.parametrize("name", ["a.pcd", "a.ply", "recording.bag"])
def test_a_recording_must_be_a_regular_file(tmp_path: Path, name: str):
    with pytest.raises(JobError, match=PIPE):
        import_recording(piped(tmp_path / name), tmp_path)


@pytest.mark.parametrize("name", ["camera.json", "groundtruth.txt", "depth/0001.png"])
def test_files_of_a_folder_of_images_must_be_regular(tmp_path: Path, name: str):
    (tmp_path / "depth").mkdir()
    (tmp_path / "depth" / "0001.png").touch()
    camera = '{"width": 8, "height": 6, "intrinsic_matrix": [9, 0, 0, 0, 9, 0, 3, 2, 1]}'
    (tmp_path / "camera.json").write_text(camera)
    piped(tmp_path / name)
    with pytest.raises(JobError, match=PIPE):
        import_recording(tmp_path, tmp_path)
