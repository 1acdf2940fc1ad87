"""``torchcal import``: what is printed, what is written, and what is never replaced."""

import json
from pathlib import Path

import pytest
import tiny_job
from arm_bag import arm
from bags import Messages, write_bag

from torchcal.cli.import_recording import packages_of
from torchcal.cli.main import main
from torchcal.errors import TorchcalError


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    m = Messages("mcap")
    tiny_job.write_files(tmp_path)
    return write_bag(tmp_path, m, arm(m))


def test_an_imported_job_can_be_checked(bag: Path, tmp_path: Path, capsys):
    out = tmp_path / "job"
    world = str(tmp_path / "cell.glb")
    assert main(["import", str(bag), "--out", str(out), "--world", world]) == 0
    printed = capsys.readouterr().out
    assert "3 of 16 images of /camera/depth/image_rect_raw were taken" in printed
    assert "FILL IN robot.base: where the robot stands" in printed
    assert f"torchcal check {out / 'job.toml'}" in printed
    assert main(["check", str(out / "job.toml"), "--json"]) == 0
    assert len(json.loads(capsys.readouterr().out)["frames"]) == 3


def test_json_is_the_only_thing_on_standard_output(bag: Path, tmp_path: Path, capsys):
    assert main(["import", str(bag), "--out", str(tmp_path / "job"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["frames"] == 3
    assert set(told["to_fill_in"]) == {"world", "robot.base"}
    assert told["job"] == str(tmp_path / "job" / "job.toml")


def test_a_job_is_never_replaced(bag: Path, tmp_path: Path, capsys):
    out = tmp_path / "job"
    main(["import", str(bag), "--out", str(out)])
    (out / "job.toml").write_text("mine")
    assert main(["import", str(bag), "--out", str(out)]) == 2
    assert "what is filled in a job by hand is never replaced" in capsys.readouterr().err
    assert (out / "job.toml").read_text() == "mine"


def test_a_mistake_is_one_line_and_leaves_nothing(tmp_path: Path, capsys):
    assert main(["import", str(tmp_path / "none.bag"), "--out", str(tmp_path / "job")]) == 2
    printed = capsys.readouterr()
    assert (printed.out, printed.err.count("\n")) == ("", 1)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("option", "value"), [("--frames", "0"), ("--depth-unit", "-1"), ("--resolution", "nan")]
)
def test_numbers_out_of_their_limits_are_mistakes(bag: Path, tmp_path: Path, capsys, option, value):
    arguments = ["import", str(bag), "--out", str(tmp_path / "job"), option, value]
    assert main(arguments) == 2
    assert f"{option}: found" in capsys.readouterr().err


@pytest.mark.parametrize("text", ["arm", "=/tmp", "arm=", "arm=/no/such/folder"])
def test_packages_are_named_with_their_folders(text: str):
    with pytest.raises(TorchcalError, match=f"--package: found {text}; expected NAME=DIR"):
        packages_of([text])


def test_the_folders_of_packages_are_read(tmp_path: Path):
    assert packages_of([f"arm={tmp_path}"]) == {"arm": tmp_path}


def test_a_missing_mesh_is_looked_for_beside_the_robot_not_in_a_folder_that_is_gone(
    bag: Path, tmp_path: Path, capsys
):
    urdf = tmp_path / "other.urdf"
    mesh = '<visual><geometry><mesh filename="arm.stl"/></geometry></visual>'
    urdf.write_text(f'<robot name="arm"><link name="camera_link">{mesh}</link></robot>')
    arguments = ["import", str(bag), "--out", str(tmp_path / "job"), "--urdf", str(urdf)]
    assert main([*arguments, "--link", "camera_link"]) == 2
    told = capsys.readouterr().err
    assert f"found arm.stl; expected an existing file: {tmp_path / 'arm.stl'}" in told
    assert ".partial-" not in told
