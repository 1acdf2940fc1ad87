"""A result's folder: what is read is what was written, and decisions are whole or not at all."""

import json
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from display_scene import calibration, job

from torchcal.calibrate.comparison_files import read_comparison
from torchcal.calibrate.decisions import Decision
from torchcal.calibrate.kept_result import kept
from torchcal.calibrate.result import Status
from torchcal.calibrate.result_folder import DECISIONS, read_result
from torchcal.cli.main import main
from torchcal.cli.output import foreign_file
from torchcal.cli.result_files import write_results
from torchcal.display.decided import decide
from torchcal.errors import TorchcalError
from torchcal.geometry.projection import Spherical
from torchcal.model.robot import load_robot
from torchcal.model.world import World, load_world, read_extras

NAMES = ("0001", "0001", "wide")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_results(calibration(NAMES), tmp_path / "out")
    return tmp_path / "out"


def world_of(file: Path) -> World:
    eye = torch.eye(4, dtype=torch.float64)
    return load_world(file, unit=1.0, T_world_file=eye, complete=False)


def assert_same_geometry(found: World, expected: World) -> None:
    assert [item.name for item in found.objects] == [item.name for item in expected.objects]
    for one, other in zip(found.objects, expected.objects, strict=True):
        np.testing.assert_array_equal(one.mesh.faces, other.mesh.faces)
        np.testing.assert_array_equal(one.mesh.vertices, other.mesh.vertices)
        torch.testing.assert_close(one.T_world_object, other.T_world_object, rtol=0.0, atol=0.0)


def test_what_is_read_is_what_was_written(folder):
    found, expected = read_result(folder), kept(calibration(NAMES))
    for name in ("status", "message", "estimated", "alpha", "projection", "bodies", "link_meshes"):
        assert getattr(found, name) == getattr(expected, name), name
    for one, other in zip(found.frames, expected.frames, strict=True):
        assert one.name == other.name
        torch.testing.assert_close(one.T_world_sensor, other.T_world_sensor, rtol=0.0, atol=0.0)
        torch.testing.assert_close(one.pose_covariance, other.pose_covariance, rtol=0.0, atol=0.0)
    transaction = found.transaction
    assert transaction.update.proposals == expected.transaction.update.proposals
    assert transaction.decisions == expected.transaction.decisions
    assert transaction.update.verdicts == expected.transaction.update.verdicts
    assert transaction.update.added[0].frames == expected.transaction.update.added[0].frames
    assert transaction.world is not None
    assert [item.name for item in transaction.world.objects] == ["crate", "wall"]


def test_comparisons_come_back_pixel_by_pixel(folder):
    read = read_result(folder).comparisons
    expected = calibration(NAMES).comparisons
    assert [comparison.name for comparison in read] == list(NAMES)
    assert len(read[1:]) == 2
    for name in ("label", "body", "colour", "normal", "usable"):
        assert torch.equal(getattr(read[2], name), getattr(expected[2], name))
    for name in ("measured", "predicted", "sigma"):
        single = getattr(expected[2], name).float()
        torch.testing.assert_close(getattr(read[2], name), single, rtol=0, atol=0, equal_nan=True)


def test_links_stand_where_base_joints_and_offsets_put_them(tmp_path):
    file = tmp_path / "arm.urdf"
    file.write_text(
        '<robot name="arm"><link name="root"/><link name="tool"><visual><geometry>'
        '<box size="0.1 0.1 0.1"/></geometry></visual></link>'
        '<joint name="lift" type="prismatic"><parent link="root"/><child link="tool"/>'
        '<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>',
        encoding="utf-8",
    )
    plain = job(("0001",))
    frame = replace(plain.frames[0], joints=torch.tensor([0.25], dtype=torch.float64))
    whole = calibration(("0001",))
    whole = replace(
        whole,
        job=replace(plain, robot=load_robot(file), link="tool", frames=(frame,)),
        estimate=replace(whole.estimate, joint_offsets={"lift": 0.5}),
    )
    write_results(whole, tmp_path / "out")
    result = read_result(tmp_path / "out")
    expected = torch.tensor([0.0, 0.0, 0.75], dtype=torch.float64)
    torch.testing.assert_close(result.frames[0].Ts_world_link["tool"][:3, 3], expected)
    np.testing.assert_allclose(result.link_meshes["tool"].extents, 0.1)
    assert result.bodies == ("wall", "crate", "robot/tool")


def test_a_spherical_sensor_comes_back(tmp_path):
    lens = Spherical(width=64, height=48, azimuth=(-0.5, 0.5), elevation=(0.25, -0.25))
    whole = calibration()
    sensor = replace(whole.job.sensor, projection=lens)
    write_results(replace(whole, job=replace(whole.job, sensor=sensor)), tmp_path / "out")
    assert read_result(tmp_path / "out").projection == lens


def test_accepting_all_and_undoing_all_gives_the_old_geometry_back(folder):
    before = (folder / "world.glb").read_bytes()
    assert set(decide(folder, accept=["all"]).decisions.values()) == {Decision.ACCEPTED}
    assert_same_geometry(world_of(folder / "world.glb"), _world_in(before, folder.parent))
    decide(folder, reject=["all"])
    assert_same_geometry(world_of(folder / "world.glb"), world_of(folder / "model" / "world.glb"))
    decide(folder, accept=["all"])
    assert_same_geometry(world_of(folder / "world.glb"), _world_in(before, folder.parent))


def _world_in(data: bytes, folder: Path) -> World:
    (folder / "before.glb").write_bytes(data)
    return world_of(folder / "before.glb")


def test_decisions_are_kept_in_the_model_that_they_made(folder):
    decide(folder, accept=["crate"], reject=["added-1"])
    said = {"crate": "accepted", "added-1": "rejected"}
    assert read_extras(folder / "world.glb") == {DECISIONS: said}
    decisions = read_result(folder).transaction.decisions
    assert {name: what.value for name, what in decisions.items()} == said


def test_a_world_of_which_nothing_is_left_still_knows_the_decisions(tmp_path):
    whole = calibration()
    gone = whole.update.verdicts["crate"]
    update = replace(whole.update, verdicts={"wall": gone, "crate": gone}, added=())
    write_results(replace(whole, update=update), tmp_path / "out")
    decide(tmp_path / "out", accept=["wall"])
    decisions = read_result(tmp_path / "out").transaction.decisions
    assert decisions == {"wall": Decision.ACCEPTED, "crate": Decision.PROPOSED}
    decide(tmp_path / "out", reject=["all"])
    assert len(world_of(tmp_path / "out" / "world.glb").objects) == 2


def test_a_stop_on_the_way_leaves_the_old_state_whole(folder, monkeypatch):
    decide(folder, accept=["all"])
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    def stopped(self: Path, target: Path) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", stopped)
    with pytest.raises(KeyboardInterrupt):
        decide(folder, reject=["all"])
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before


def test_what_a_killed_program_leaves_does_not_keep_the_folder_from_being_replaced(folder):
    (folder / ".world.partial-0a1b2c3d.glb").write_bytes(b"half")
    assert foreign_file(folder) is None


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda folder: (folder / "model" / "record.json").unlink(), r"no model/record\.json"),
        (
            lambda folder: (folder / "result.json").write_text("{"),
            r"result\.json, which is no JSON",
        ),
        (lambda folder: (folder / "result.json").write_text("{}"), r"other contents \(KeyError"),
    ],
)
def test_folders_that_are_no_result_are_named(folder, spoil, words):
    spoil(folder)
    with pytest.raises(TorchcalError, match=words) as error:
        read_result(folder)
    assert str(folder) in str(error.value)


@pytest.mark.parametrize("part", ["world.glb", "added.glb"])
def test_a_part_that_is_missing_is_named_and_the_model_stays(folder, part):
    before = (folder / "world.glb").read_bytes()
    (folder / "model" / part).unlink()
    with pytest.raises(TorchcalError, match=rf"found no model/{part}"):
        decide(folder, reject=["all"])
    assert (folder / "world.glb").read_bytes() == before


@pytest.mark.parametrize("extras", [[], None, 3, {DECISIONS: []}, {DECISIONS: 3}])
def test_extras_of_another_program_are_an_error_and_no_traceback(folder, extras, monkeypatch):
    module = sys.modules["torchcal.calibrate.result_folder"]
    monkeypatch.setattr(module, "read_extras", lambda _: extras)
    with pytest.raises(TorchcalError, match="other contents"):
        read_result(folder)


@pytest.mark.parametrize("content", [b"", b"no arrays"])
def test_arrays_that_cannot_be_read_are_named(folder, content):
    file = sorted((folder / "frames").iterdir())[0]
    file.write_bytes(content)
    with pytest.raises(TorchcalError, match=file.name):
        read_comparison(file, "0001")


def test_who_decides_at_the_same_time_waits_and_loses_nothing(folder):
    names = sorted(read_result(folder).transaction.decisions)
    with ThreadPoolExecutor() as pool:
        list(pool.map(lambda name: decide(folder, reject=[name]), names))
    decisions = read_result(folder).transaction.decisions
    assert set(decisions.values()) == {Decision.REJECTED}
    assert foreign_file(folder) is None


def test_update_lists_proposals_with_evidence_and_decisions(folder, capsys):
    assert main(["update", str(folder)]) == 0
    printed = capsys.readouterr().out
    assert "256 seen through" in printed
    assert "120 measured" in printed
    assert printed.count("proposed") >= 2
    assert main(["update", str(folder), "--accept", "crate", "--reject", "added-1"]) == 0
    printed = capsys.readouterr().out
    assert "accepted" in printed
    assert "rejected" in printed
    assert [item.name for item in world_of(folder / "world.glb").objects] == ["wall"]


def test_update_as_json_says_what_the_table_says(folder, capsys):
    assert main(["update", str(folder), "--accept", "crate", "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["world"] == "world.glb"
    assert printed["proposals"][0] == {
        "name": "crate",
        "change": "remove",
        "decision": "accepted",
        "evidence": {"supporting": 256, "contradicting": 0, "hidden": 0},
        "frames": ["0001"],
    }
    assert printed["proposals"][1]["frames"] == ["0001"]


def test_update_refuses_unknown_names_and_changes_nothing(folder, capsys):
    before = (folder / "world.glb").read_bytes()
    assert main(["update", str(folder), "--accept", "crate", "drum"]) == 2
    assert "no proposal 'drum'; expected one of added-1, crate" in capsys.readouterr().err
    assert (folder / "world.glb").read_bytes() == before


def test_proposals_of_a_calibration_that_failed_are_listed_with_a_warning(tmp_path, capsys):
    write_results(calibration(status=Status.AMBIGUOUS), tmp_path / "out")
    assert main(["update", str(tmp_path / "out")]) == 3
    assert "The calibration is ambiguous" in capsys.readouterr().out


def test_a_calibration_without_proposals_says_so(tmp_path, capsys):
    whole = calibration()
    verdicts = {"wall": whole.update.verdicts["wall"]}
    update = replace(whole.update, verdicts=verdicts, added=())
    write_results(replace(whole, update=update), tmp_path / "out")
    assert main(["update", str(tmp_path / "out")]) == 0
    assert "No change of the model is proposed." in capsys.readouterr().out
