"""The robot and the rest of a job's folder: meshes, packages, worlds and other jobs of the cell."""

import shutil
import tomllib
from pathlib import Path

import pytest
import tiny_job
import torch
import trimesh
from bags import Messages, write_bag
from test_import_bag import arm

from torchcal.errors import JobError
from torchcal.model.read_job import read_job
from torchcal.model.recordings.import_recording import import_recording
from torchcal.model.recordings.recorded import RobotSource, Selection
from torchcal.model.recordings.robot_files import copy_robot

MESHED = """\
<robot name="arm"><link name="foot"><visual><geometry>
<mesh filename="{name}"/></geometry></visual>
<collision><geometry><mesh filename="package://gone/hull.stl"/></geometry></collision></link></robot>
"""


@pytest.fixture
def package(tmp_path: Path) -> Path:
    folder = tmp_path / "somewhere" / "arm_description"
    (folder / "meshes").mkdir(parents=True)
    trimesh.creation.box((0.1, 0.1, 0.1)).export(folder / "meshes" / "foot.stl")
    return folder


def source(name: str, folder: Path) -> RobotSource:
    return RobotSource(xml=MESHED.format(name=name).encode(), named=folder / "robot_description")


def test_meshes_of_packages_are_copied(tmp_path: Path, package: Path):
    name = "package://arm_description/meshes/foot.stl"
    urdf = copy_robot(source(name, tmp_path), tmp_path / "robot", {"arm_description": package})
    shutil.rmtree(package)
    assert (urdf.parent / "meshes" / "foot.stl").is_file()
    text = urdf.read_text()
    assert 'filename="meshes/foot.stl"' in text
    # Nothing shows a collision shape where there is a visual one: it may be missing.
    assert "package://gone/hull.stl" in text


def test_a_package_that_is_not_there_says_how_to_name_it(tmp_path: Path):
    name = "package://arm_description/meshes/foot.stl"
    with pytest.raises(JobError, match=r"found package://arm_.* or --package NAME=FOLDER, which"):
        copy_robot(source(name, tmp_path), tmp_path / "robot", {})


def test_a_mesh_that_is_not_there_names_its_link(tmp_path: Path):
    with pytest.raises(JobError, match=r"robot_description: link\.foot\.visual\[0\].* foot\.stl"):
        copy_robot(source("foot.stl", tmp_path), tmp_path / "robot", {})


@pytest.mark.parametrize("xml", ["", "<a/>", "<!DOCTYPE x><robot/>", "no xml"])
def test_a_broken_description_is_a_mistake(tmp_path: Path, xml: str):
    m = Messages("mcap")
    content = [*arm(m, without=("/robot_description",)), ("/robot_description", 0.0, m.text(xml))]
    bag = write_bag(tmp_path, m, content)
    with pytest.raises(JobError, match="robot_description: .*expected a URDF: XML whose root"):
        import_recording(bag, tmp_path)


def recorded(tmp_path: Path, *without: str) -> Path:
    m = Messages("mcap")
    (tmp_path / "out").mkdir()
    return write_bag(tmp_path, m, arm(m, without=without))


def test_a_urdf_from_a_file_takes_the_place_of_the_topic(tmp_path: Path):
    (tmp_path / "arm.urdf").write_text(tiny_job.urdf().replace("name='arm'", "name='other'"))
    selection = Selection(urdf=tmp_path / "arm.urdf")
    made = import_recording(recorded(tmp_path), tmp_path / "out", selection=selection)
    robot = read_job(made.job).robot
    assert robot is not None
    assert robot.name == "other"


def test_a_urdf_that_is_not_there_is_a_mistake(tmp_path: Path):
    selection = Selection(urdf=tmp_path / "none.urdf")
    with pytest.raises(JobError, match="none.urdf: found no such file; expected a URDF"):
        import_recording(recorded(tmp_path), tmp_path / "out", selection=selection)


def test_a_link_that_is_not_there_lists_those_that_are(tmp_path: Path):
    with pytest.raises(JobError, match="--link: found hand; expected one of .*tool, upper, world"):
        import_recording(recorded(tmp_path), tmp_path / "out", selection=Selection(link="hand"))


def test_the_world_is_copied(tmp_path: Path):
    tiny_job.write_files(tmp_path)
    made = import_recording(recorded(tmp_path), tmp_path / "out", world=tmp_path / "cell.glb")
    (tmp_path / "cell.glb").unlink()
    world = read_job(made.job).world
    assert world is not None
    assert [each.name for each in world.objects] == ["crate"]
    assert "world" not in made.to_fill_in


def test_a_world_that_is_not_there_is_a_mistake(tmp_path: Path):
    with pytest.raises(JobError, match="none.glb: found no such file"):
        import_recording(recorded(tmp_path), tmp_path / "out", world=tmp_path / "none.glb")


LIKE = """\
[world]
model = "cell.glb"
complete = true

[robot]
urdf = "arm.urdf"
base = { xyz = [1, 2, 3] }

[sensor]
link = "tool"
mount = { xyz = [0, 0, 0.25] }
model = "pinhole"
depth_unit = 0.0005
range = [0.1, 9.0]
sigma = 0.007
drift = 0
beam = 3

[unknown.mount]
position_sigma = 0.01
rotation_sigma_deg = 1.0
"""


def test_what_the_recording_cannot_know_is_taken_from_another_job(tmp_path: Path):
    like = tmp_path / "like"
    like.mkdir()
    tiny_job.write(like, LIKE)
    made = import_recording(
        recorded(tmp_path, "/robot_description"), tmp_path / "out", like=like / "job.toml"
    )
    job = read_job(made.job)
    assert job.world is not None
    assert job.world.complete
    assert job.T_world_base[:3, 3].tolist() == [1.0, 2.0, 3.0]
    assert job.T_link_sensor[:3, 3].tolist() == [0.0, 0.0, 0.25]
    assert (job.sensor.noise.a, job.sensor.near, job.sensor.far) == (0.007, 0.1, 9.0)
    assert (job.sensor.beam, job.sensor.depth_unit) == (3, 0.0005)
    assert job.base is None
    assert job.mount is not None
    assert job.robot is not None
    assert job.sensor.projection.width == 8
    assert not made.to_fill_in
    assert "a guess" not in made.job.read_text()


def test_what_is_asked_for_wins_over_another_job(tmp_path: Path):
    like = tmp_path / "like"
    like.mkdir()
    tiny_job.write(like, LIKE)
    selection = Selection(depth_unit=0.002, link="finger")
    made = import_recording(
        recorded(tmp_path), tmp_path / "out", selection=selection, like=like / "job.toml"
    )
    sensor = tomllib.loads(made.job.read_text())["sensor"]
    assert (sensor["depth_unit"], sensor["link"]) == (0.002, "finger")
    # Another link: the other job's mount is not the sensor's.
    torch.testing.assert_close(sensor["mount"]["xyz"], [0.0, 0.0, 0.0])


def test_another_job_that_cannot_be_read_is_a_mistake(tmp_path: Path):
    (tmp_path / "like.toml").write_text("[world")
    with pytest.raises(JobError, match="like.toml: found a job that cannot be read"):
        import_recording(recorded(tmp_path), tmp_path / "out", like=tmp_path / "like.toml")
