"""``torchcal follow``: a line for each frame whatever the frame is, and an honest exit status."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
import recordings
import torch
from recordings import pose

from torchcal.cli.main import main
from torchcal.geometry import se3
from torchcal.model.read_job import read_job, read_recording
from torchcal.model.world import write_world

JOB = """\
[world]
model = "room.glb"

[sensor]
model = "pinhole"
width = 64
height = 48
fx = 55.0
fy = 54.0
cx = 31.2
cy = 23.9
range = [0.1, 20.0]
sigma = 0.005
drift = 0
beam = 1

[unknown.base]
position_sigma = 0.1
rotation_sigma_deg = 5.0
"""
TRUTHS = (pose(0.02, 0.0, -0.03, 0.0, 0.02, 0.0), pose(0.03, 0.02, -0.02, 0.0, 0.03, 0.02))
WANDERING = ("--shift", "0.03", "--turn-deg", "2")


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The room and some images of it."""
    folder = tmp_path_factory.mktemp("follow")
    write_world(recordings.world_of(recordings.room()), folder / "room.glb")
    meshes = list(recordings.room().values())
    for k, truth in enumerate(TRUTHS):
        image = recordings.record(meshes, truth, recordings.sensor(), seed=k)
        np.save(folder / f"{k}.npy", image.numpy())
    np.save(folder / "small.npy", np.ones((24, 32)))
    np.save(folder / "nothing.npy", np.full((48, 64), np.nan))
    np.save(folder / "covered.npy", np.full((48, 64), 0.3))
    return folder


def job(folder: Path, *images: str, more: str = "") -> str:
    frames = "".join(f'\n[[frame]]\ndepth = "{name}.npy"\npose = {{}}\n' for name in images)
    file = folder / f"{'-'.join(images)}.toml"
    file.write_text(JOB + frames + more)
    return str(file)


def lines(out: Path) -> list[dict]:
    return [json.loads(line) for line in (out / "frames.jsonl").read_text().splitlines()]


def test_every_frame_has_a_line_and_bad_ones_a_reason(folder, tmp_path, capsys):
    out = tmp_path / "out"
    command = ["follow", job(folder, "0", "small", "gone", "nothing", "1"), "--out", str(out)]
    assert main([*command, *WANDERING]) == 0
    taken = lines(out)
    assert [each["name"] for each in taken] == ["0", "small", "gone", "nothing", "1"]
    unusable = ["unusable"] * 3
    assert [each["status"] for each in taken] == ["tracking", *unusable, "tracking"]
    assert "32x24" in taken[1]["message"]
    assert "does not exist" in taken[2]["message"]
    assert "every pixel is 0, NaN" in taken[3]["message"]
    for each, truth in ((taken[0], TRUTHS[0]), (taken[-1], TRUTHS[1])):
        T = torch.tensor(each["T_world_sensor"], dtype=torch.float64)
        error = se3.log(se3.inverse(T) @ truth)
        sigma = torch.tensor(each["position_sigma_m"] + each["rotation_sigma_rad"])
        assert (error.abs() < 5.0 * sigma).all()
    found = json.loads((out / "result.json").read_text())
    assert found["frames"] == {"tracking": 2, "lost": 0, "ambiguous": 0, "unusable": 3}
    assert (found["status"], found["alarms"]) == ("tracking", [])
    assert found["last"] == taken[-1]
    printed = capsys.readouterr().out
    assert "5 frames: 2 tracking, 3 unusable" in printed
    assert re.search(r"agrees with (9[0-9]|100)\.[0-9] % of what was measured in frame", printed)
    assert str(out / "frames.jsonl") in printed


def test_json_prints_the_lines_and_a_lost_camera_is_an_exit_status(folder, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["follow", job(folder, "0", "covered"), "--out", str(out), "--json"]
    assert main(arguments) == 3
    assert capsys.readouterr().out == (out / "frames.jsonl").read_text()
    assert [each["status"] for each in lines(out)] == ["tracking", "lost"]
    assert main(arguments) == 3  # an earlier result is replaced


def test_where_nothing_was_explained_the_last_words_are_advice(folder, tmp_path, capsys):
    out, file = tmp_path / "out", job(folder, "covered", "gone")
    advice = f"no frame was explained: torchcal check {file} names mistakes that it finds"
    assert main(["follow", file, "--out", str(out)]) == 3
    assert capsys.readouterr().err.splitlines()[-1] == advice
    assert main(["follow", job(folder, "0", "covered"), "--out", str(out)]) == 3
    assert "torchcal check" not in capsys.readouterr().err


def test_images_that_a_driver_repeats_make_nothing_surer(folder, tmp_path):
    out = tmp_path / "out"
    assert main(["follow", job(folder, "0", "0", "1"), "--out", str(out), *WANDERING]) == 0
    first, again, _ = lines(out)
    assert [each["status"] for each in lines(out)] == ["tracking"] * 3
    assert again["message"].endswith("it tells nothing new.")
    assert again["position_sigma_m"] > first["position_sigma_m"]


def test_an_alarm_in_the_last_frame_is_an_exit_status(folder, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["follow", job(folder, "0", "1"), "--out", str(out)]) == 3
    assert [each["alarm"] for each in lines(out)] == [False, True]
    alarms = json.loads((out / "result.json").read_text())["alarms"]
    assert [each["name"] for each in alarms] == ["1"]
    assert "ALARM 1: The image contradicts" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "more", "words"),
    [
        (("--shift", "0.1"), "", "expected both"),
        (("--shift", "-1", "--turn-deg", "1"), "", "expected both, 0 or more"),
    ],
)
def test_mistakes_are_one_line_and_nothing_is_written(
    folder, tmp_path, capsys, arguments, more, words
):
    out = tmp_path / "out"
    assert main(["follow", job(folder, "0", more=more), "--out", str(out), *arguments]) == 2
    assert words in capsys.readouterr().err
    assert not out.exists()


def test_images_are_read_when_they_are_asked_for(folder):
    recording = read_recording(job(folder, "gone", "1"))
    assert recording.job.frames == ()
    assert [file.name for file in recording.files] == ["gone", "1"]
    frame = recording.frame(1)
    expected = read_job(job(folder, "1")).frames[0]
    torch.testing.assert_close(frame.image.range, expected.image.range, equal_nan=True)
