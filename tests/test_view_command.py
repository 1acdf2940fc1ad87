"""``torchcal view``: what a person asked to see, and what is missing for it."""

import importlib.util
import json
import shutil
import socket
from pathlib import Path

import pytest
from display_scene import calibration, job
from rich.console import Console

from torchcal.calibrate.decisions import Decision
from torchcal.calibrate.result_folder import read_result
from torchcal.cli import view
from torchcal.cli.main import main
from torchcal.cli.options import View
from torchcal.cli.result_files import write_results
from torchcal.display.view.source import FolderSource, KeptSource
from torchcal.errors import TorchcalError


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_results(calibration(), tmp_path / "out")
    return tmp_path / "out"


def source_of(place: Path):
    return view.source_of(View(result=place), Console(quiet=True))


def test_a_folder_is_shown_and_decided_as_update_does(folder):
    source = source_of(folder)
    assert isinstance(source, FolderSource)
    result = source.latest(None)
    assert source.latest(result) is result
    source.decide(accept=["crate"], reject=())
    decided = source.latest(result)
    assert decided.transaction.decisions["crate"] == Decision.ACCEPTED
    assert decided.comparisons is result.comparisons
    assert read_result(folder).transaction.decisions == decided.transaction.decisions
    with pytest.raises(TorchcalError, match="no proposal 'drum'"):
        source.decide(accept=["drum"], reject=())


def test_another_result_in_the_folder_is_not_mixed_with_the_one_that_is_shown(folder):
    source = source_of(folder)
    result = source.latest(None)
    shutil.rmtree(folder)
    write_results(calibration(), folder)
    with pytest.raises(TorchcalError, match="start torchcal view anew"):
        source.latest(result)


def test_a_job_is_compared_at_its_nominal_pose_and_nothing_can_be_decided(monkeypatch, tmp_path):
    told = {}

    def calibrate(read, *, estimate, generator, progress):
        told["estimate"] = estimate
        return calibration()

    monkeypatch.setattr(view, "read_job", lambda file, device: job(("0001", "0002")))
    monkeypatch.setattr(view, "calibrate", calibrate)
    source = source_of(tmp_path / "job.toml")
    assert isinstance(source, KeptSource)
    assert told == {"estimate": False}
    assert len(source.latest(None).frames) == 2
    with pytest.raises(TorchcalError, match="the folder of a calibration"):
        source.decide(accept=["crate"], reject=())


def test_the_folder_of_a_recording_names_the_command_for_it(tmp_path):
    (tmp_path / "frames.jsonl").write_text("")
    with pytest.raises(TorchcalError, match="torchcal view JOB --follow"):
        source_of(tmp_path)


def test_a_missing_viser_is_one_line_that_says_what_to_install(folder, monkeypatch, capsys):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert main(["view", str(folder)]) == 2
    printed = capsys.readouterr()
    assert "pip install 'torchcal[view]'" in printed.err
    assert printed.out == ""


def test_a_taken_port_that_was_asked_for_is_one_line_before_anything_is_read(tmp_path, capsys):
    pytest.importorskip("viser", reason="needs viser, the extra view")
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        assert main(["view", str(tmp_path / "none.toml"), "--port", str(port)]) == 2
    assert f"--host 127.0.0.1 --port {port}: found" in capsys.readouterr().err


def test_a_taken_port_that_nobody_asked_for_makes_way_for_the_next_free_one(
    folder, monkeypatch, capsys
):
    app = pytest.importorskip("torchcal.display.view.app")
    monkeypatch.setattr(app.View, "watch", lambda window: None)
    with socket.create_server(("127.0.0.1", 0)) as listening:
        port = listening.getsockname()[1]
        monkeypatch.setattr(view, "PORT", port)
        assert main(["view", str(folder), "--json"]) == 0
    address = json.loads(capsys.readouterr().out)["address"]
    assert address.startswith("http://127.0.0.1:")
    assert int(address.rpartition(":")[2]) > port


def test_it_listens_on_this_machine_alone_unless_told_otherwise():
    assert View(result=Path("out")).host == "127.0.0.1"
