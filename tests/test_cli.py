"""The commands: exit status, what is printed where, and folders that are replaced whole or not."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from display_scene import HEIGHT, WIDTH, calibration, job

from torchcal.calibrate.check_result import (
    FrameCheck,
    JobCheck,
    ParameterCheck,
)
from torchcal.calibrate.result import (
    Status,
    UnobservableDirection,
)
from torchcal.cli import commands
from torchcal.cli.main import main
from torchcal.cli.output import input_files, replaced_folder
from torchcal.cli.result_files import result_dict
from torchcal.demo import DemoTruth
from torchcal.errors import JobError, TorchcalError

CHECK = JobCheck(
    frames=(
        FrameCheck(
            name="0001",
            measured_fraction=0.9,
            usable_fraction=0.8,
            model_fraction=0.7,
            median_range_m=2.5,
            predicted_median_range_m=float("nan"),
            warnings=("far from the model",),
        ),
    ),
    parameters=(ParameterCheck(name="base.rx", unit="rad", prior_sigma=0.1, expected_sigma=0.01),),
    unobservable=(UnobservableDirection(words="the yaw", vector=torch.ones(1)),),
    warnings=("few frames",),
)


@pytest.fixture
def library(monkeypatch):
    """The commands on a library that answers at once; returns what ``calibrate`` was told."""
    told: dict = {}

    def calibrate(read, *, estimate, generator, progress):
        progress("estimate", 0.5)
        told.update(estimate=estimate, seed=generator.initial_seed(), frames=len(read.frames))
        return calibration(status=told.get("status", Status.CONVERGED))

    monkeypatch.setattr(commands, "read_job", lambda file, device: job(("0001", "0002")))
    monkeypatch.setattr(commands, "calibrate", calibrate)
    monkeypatch.setattr(commands, "check", lambda read: CHECK)
    ranges = torch.full((HEIGHT, WIDTH), 2.0, dtype=torch.float64)
    monkeypatch.setattr(commands, "predict", lambda read: (ranges, ranges + 1.0))
    return told


def leftovers(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("status", "code"),
    [
        (Status.CONVERGED, 0),
        (Status.AMBIGUOUS, 3),
        (Status.UNOBSERVABLE, 3),
        (Status.FAILED, 3),
    ],
)
def test_exit_status_is_zero_only_for_a_usable_answer(library, tmp_path, status, code):
    library["status"] = status
    assert main(["calibrate", "job.toml", "--out", str(tmp_path / "out")]) == code
    written = json.loads((tmp_path / "out" / "result.json").read_text(encoding="utf-8"))
    assert written["status"] == status.value


def test_json_is_the_only_thing_on_standard_output(library, tmp_path, capsys):
    main(["calibrate", "job.toml", "--out", str(tmp_path / "out"), "--json"])
    printed = capsys.readouterr().out
    assert json.loads(printed) == result_dict(calibration())
    assert printed == (tmp_path / "out" / "result.json").read_text(encoding="utf-8")


def test_calibrate_prints_the_answer_and_where_the_report_is(library, tmp_path, capsys):
    main(["calibrate", "job.toml", "--out", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert "The answer can be used" in printed
    assert "+10.0 mm" in printed
    assert str(tmp_path / "out" / "report.html") in printed


def test_options_reach_the_library(library, tmp_path):
    out = str(tmp_path / "out")
    main(["calibrate", "job.toml", "--out", out, "--no-estimate", "--seed", "7"])
    assert library == {"estimate": False, "seed": 7, "frames": 2}


def test_render_writes_metres_as_float32(library, tmp_path, capsys):
    assert main(["render", "job.toml", "--out", str(tmp_path / "out"), "--json"]) == 0
    ranges = np.load(tmp_path / "out" / "depth" / "0002.npy")
    assert ranges.dtype == np.float32
    np.testing.assert_array_equal(ranges, np.full((HEIGHT, WIDTH), 3.0, dtype=np.float32))
    assert (tmp_path / "out" / "preview" / "0002.png").is_file()
    assert len(json.loads(capsys.readouterr().out)["frames"]) == 2


def test_check_shows_warnings_and_what_cannot_be_known(library, capsys):
    assert main(["check", "job.toml"]) == 0
    printed = capsys.readouterr().out
    assert "warning: few frames" in printed
    assert "0001: far from the model" in printed
    assert "the yaw" in printed
    assert "5.73 °" in printed  # 0.1 rad


def test_check_as_json_has_null_for_what_is_not_there(library, capsys):
    assert main(["check", "job.toml", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["frames"][0]["predicted_median_range_m"] is None


def test_demo_compares_with_the_truth(library, tmp_path, capsys, monkeypatch):
    truth = DemoTruth(
        job=tmp_path / "job.toml",
        T_world_base=torch.eye(4, dtype=torch.float64),
        removed=("crate",),
        added={"box": ((1.0, 0.0, 0.05), (0.2, 0.3, 0.4))},
        objects=("wall", "crate"),
    )
    monkeypatch.setattr(commands, "make_demo", lambda folder, seed, progress: truth)
    assert main(["demo", "--out", str(tmp_path / "demo")]) == 0
    printed = capsys.readouterr().out
    assert "added-1, 50 mm off" in printed
    assert "0.000 mm off" in printed
    assert (tmp_path / "demo" / "result" / "report.html").is_file()


def test_a_job_that_cannot_be_read_is_one_line_and_leaves_nothing(tmp_path, capsys):
    missing = tmp_path / "none.toml"
    assert main(["calibrate", str(missing), "--out", str(tmp_path / "out")]) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.count("\n") == 1
    assert printed.err.startswith("error: ")
    assert str(missing) in printed.err
    assert leftovers(tmp_path) == []


def test_a_missing_gpu_is_a_clear_error(library, capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert main(["check", "job.toml", "--device", "cuda"]) == 2
    assert "torch sees no GPU" in capsys.readouterr().err


@pytest.mark.parametrize("arguments", [[], ["look", "x"], ["calibrate", "job.toml"]])
def test_mistyped_commands_end_with_two(arguments, capsys):
    with pytest.raises(SystemExit) as ending:
        main(arguments)
    assert ending.value.code == 2


@pytest.mark.parametrize(
    "command", ["", "calibrate", "follow", "render", "check", "batch", "import", "view", "update"]
)
def test_help_ends_with_zero(command, capsys):
    with pytest.raises(SystemExit) as ending:
        main([*command.split(), "--help"])
    assert ending.value.code == 0
    assert "usage: torchcal" in capsys.readouterr().out


def test_an_earlier_result_is_replaced_as_a_whole(library, tmp_path):
    out = tmp_path / "out"
    main(["calibrate", "job.toml", "--out", str(out)])
    stale = out / "hybrid" / "stale.png"
    stale.write_bytes(b"")
    assert main(["calibrate", "job.toml", "--out", str(out)]) == 0
    assert not stale.exists()
    assert leftovers(tmp_path) == ["out"]


def test_an_earlier_result_survives_an_interruption(library, tmp_path, monkeypatch):
    out = tmp_path / "out"
    main(["calibrate", "job.toml", "--out", str(out)])
    before = (out / "result.json").read_bytes()

    def interrupted(*arguments):
        raise KeyboardInterrupt

    monkeypatch.setattr(commands, "write_results", interrupted)
    assert main(["calibrate", "job.toml", "--out", str(out)]) == 130
    assert (out / "result.json").read_bytes() == before
    assert leftovers(tmp_path) == ["out"]


@pytest.mark.parametrize("inside", ["notes.txt", "hybrid/deep/0001.png", "src/job/main.c"])
def test_files_of_others_are_never_lost(library, tmp_path, capsys, inside):
    out = tmp_path / "out"
    main(["calibrate", "job.toml", "--out", str(out)])
    precious = out / inside
    precious.parent.mkdir(parents=True, exist_ok=True)
    precious.write_text("mine", encoding="utf-8")
    assert main(["calibrate", "job.toml", "--out", str(out)]) == 2
    assert inside in capsys.readouterr().err
    assert precious.read_text(encoding="utf-8") == "mine"


def test_a_folder_without_a_result_is_not_replaced(tmp_path):
    meshes = tmp_path / "meshes"
    meshes.mkdir()
    (meshes / "link.stl").write_bytes(b"")
    with pytest.raises(TorchcalError, match=r"meshes.link\.stl"), replaced_folder(tmp_path):
        pass
    assert (meshes / "link.stl").exists()


def test_an_empty_folder_may_be_replaced(tmp_path):
    with replaced_folder(tmp_path / "out") as first:
        (first / "result.json").write_text("{}", encoding="utf-8")
    assert leftovers(tmp_path / "out") == ["result.json"]


def test_the_folder_of_an_input_is_not_replaced(library, tmp_path, capsys):
    file = tmp_path / "cell" / "job.toml"
    (tmp_path / "cell" / "depth").mkdir(parents=True)
    (tmp_path / "cell" / "depth" / "0001.png").write_bytes(b"")
    file.write_text('[[frame]]\ndepth = "depth/0001.png"\n', encoding="utf-8")
    assert input_files(file) == (file, file.parent / "depth" / "0001.png")
    for folder in (tmp_path, file.parent, file.parent / "depth"):
        assert main(["calibrate", str(file), "--out", str(folder)]) == 2
        assert "input" in capsys.readouterr().err
    assert file.exists()


def test_a_file_in_the_place_of_the_folder_is_kept(library, tmp_path, capsys):
    out = tmp_path / "out"
    out.write_text("mine", encoding="utf-8")
    assert main(["calibrate", "job.toml", "--out", str(out)]) == 2
    assert "expected a folder" in capsys.readouterr().err
    assert out.read_text(encoding="utf-8") == "mine"


def test_an_error_on_the_way_leaves_no_partial_folder(tmp_path):
    def fail_half_way():
        with replaced_folder(tmp_path / "out") as folder:
            (folder / "result.json").write_text("{}", encoding="utf-8")
            raise JobError("job.toml", "frame[1].depth", "nothing", "an image")

    with pytest.raises(JobError):
        fail_half_way()
    assert leftovers(tmp_path) == []
