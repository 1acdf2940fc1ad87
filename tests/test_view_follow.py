"""The view of a running ``torchcal follow``: whole lines only, and the frame as it was believed."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
import recordings
import torch
from recordings import pose
from test_follow import JOB, TRUTHS, WANDERING

from torchcal.calibrate.followed import Followed
from torchcal.calibrate.result import PixelClass, Status
from torchcal.cli.main import main
from torchcal.cli.unfinished import newest, unfinished
from torchcal.display.view.follow import WAITING, FollowSource
from torchcal.display.view.words import headline
from torchcal.errors import TorchcalError
from torchcal.geometry import se3
from torchcal.model.read_job import read_recording
from torchcal.model.world import write_world


@pytest.fixture(scope="module")
def followed(tmp_path_factory) -> tuple[Path, Path]:
    """A job and what ``torchcal follow`` wrote about it; its second image cannot be read."""
    folder = tmp_path_factory.mktemp("followed")
    write_world(recordings.world_of(recordings.room()), folder / "room.glb")
    for k, truth in enumerate(TRUTHS):
        meshes = list(recordings.room().values())
        image = recordings.record(meshes, truth, recordings.sensor(), seed=k)
        np.save(folder / f"{k}.npy", image.numpy())
    names = ("0", "gone", "1")
    frames = "".join(f'\n[[frame]]\ndepth = "{name}.npy"\npose = {{}}\n' for name in names)
    (folder / "job.toml").write_text(JOB + frames)
    out = folder / "out"
    assert main(["follow", str(folder / "job.toml"), "--out", str(out), *WANDERING]) == 0
    return folder / "job.toml", out / "frames.jsonl"


def source_of(job: Path, file: Path) -> FollowSource:
    return FollowSource(Followed.of(read_recording(job)), lambda: file if file.exists() else None)


def test_frames_come_with_their_lines(followed, tmp_path):
    job, written = followed
    lines, file = written.read_text().splitlines(keepends=True), tmp_path / "frames.jsonl"
    source = source_of(job, file)
    empty = source.latest(None)
    assert (empty.message, empty.frames) == (WAITING, ())
    assert source.latest(empty) is empty
    file.write_text(lines[0] + lines[1][:50])
    one = source.latest(empty)
    assert [frame.name for frame in one.frames] == ["0"]
    assert one.status == Status.CONVERGED
    assert source.latest(one) is one
    file.write_text("".join(lines))
    three = source.latest(one)
    assert [frame.name for frame in three.frames] == ["0", "gone", "1"]
    for place, line in zip(three.frames, lines, strict=True):
        said = json.loads(line)
        expected = torch.tensor(said["T_world_sensor"], dtype=torch.float64)
        torch.testing.assert_close(place.T_world_sensor, expected, rtol=0.0, atol=1e-9)
        sigma = place.pose_covariance.diagonal().sqrt().tolist()
        stated = [*said["position_sigma_m"], *said["rotation_sigma_rad"]]
        np.testing.assert_allclose(sigma, stated, rtol=1e-9)


def test_a_followed_frame_is_compared_where_the_sensor_was_believed_to_be(followed):
    """A room without errors agrees with itself at the tracked pose, and only there."""
    result = source_of(*followed).latest(None)
    first, unread, last = result.comparisons
    for comparison in (first, last):
        compared = comparison.label != PixelClass.NOT_COMPARED
        agrees = comparison.label == PixelClass.AGREES
        assert float(agrees.sum() / compared.sum()) > 0.97
    assert not unread.measured.isfinite().any()


def test_a_lost_frame_or_an_alarm_is_told(followed, tmp_path):
    job, written = followed
    line = json.loads(written.read_text().splitlines()[0])
    for change, status, words in (
        ({"status": "lost"}, Status.FAILED, "lost, frame 0"),
        ({"status": "ambiguous"}, Status.AMBIGUOUS, "ambiguous, frame 0"),
        ({"alarm": True}, Status.FAILED, "ALARM: "),
    ):
        (tmp_path / "frames.jsonl").write_text(json.dumps(line | change) + "\n")
        result = source_of(job, tmp_path / "frames.jsonl").latest(None)
        assert result.status == status
        assert result.message.startswith(words)


def test_another_run_begins_anew(followed, tmp_path):
    job, written = followed
    lines, file = written.read_text().splitlines(keepends=True), tmp_path / "frames.jsonl"
    file.write_text("".join(lines))
    source = source_of(job, file)
    assert len(source.latest(None).frames) == 3
    (tmp_path / "next").write_text(lines[0])
    (tmp_path / "next").replace(file)
    assert len(source.latest(None).frames) == 1


def test_lines_of_another_version_are_refused(followed, tmp_path):
    job, written = followed
    line = json.loads(written.read_text().splitlines()[0])
    del line["covariance"]
    (tmp_path / "frames.jsonl").write_text(json.dumps(line) + "\n")
    with pytest.raises(TorchcalError, match="a line without 'covariance'"):
        source_of(job, tmp_path / "frames.jsonl").latest(None)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"gone.npy"', '"1.npy"', "found frame gone in what torchcal follow wrote; expected 1"),
        ('\n[[frame]]\ndepth = "1.npy"\npose = {}\n', "", "more than 2 frames"),
        ("[unknown.base]\n", "[unknown.base]\nrotation_sigma_deg = 0\n", "the unknowns base.x, "),
        ("pose = {}", "pose = { xyz = [0, 0, 0.01] }", "elsewhere than its corrections put it"),
    ],
)
def test_lines_of_another_job_are_refused(followed, old, new, words):
    job, written = followed
    text = job.read_text()
    if "rotation_sigma_deg" in new:
        text = re.sub(r"(?m)^rotation_sigma_deg.*\n", "", text)
    assert old in text
    other = job.with_name("other.toml")
    other.write_text(text.replace(old, new))
    with pytest.raises(TorchcalError, match=re.escape(words)):
        source_of(other, written).latest(None)


def test_what_is_followed_is_not_called_an_answer(followed, tmp_path):
    job, written = followed
    waiting = headline(source_of(job, tmp_path / "none").latest(None))
    assert waiting == f"**{WAITING}**"
    assert "answer" not in headline(source_of(job, written).latest(None))


def test_a_recording_has_nothing_to_decide(followed):
    source = source_of(*followed)
    assert not source.can_decide
    with pytest.raises(TorchcalError, match="folder of a calibration"):
        source.decide(accept=["all"], reject=[])


def test_the_file_that_is_being_written_is_found_before_an_earlier_one(tmp_path):
    out = tmp_path / "out"
    assert newest(out, "frames.jsonl") is None
    with unfinished(out) as partial:
        for folder, stamp in ((out, 1), (partial, 2)):
            folder.mkdir(exist_ok=True)
            (folder / "frames.jsonl").write_text("")
            _set_time(folder / "frames.jsonl", stamp)
        assert newest(out, "frames.jsonl") == partial / "frames.jsonl"
        _set_time(out / "frames.jsonl", 3)
        assert newest(out, "frames.jsonl") == out / "frames.jsonl"


def test_what_a_killed_run_left_is_not_found_before_a_result(tmp_path):
    out, left = tmp_path / "out", tmp_path / ".out.partial-0123abcd"
    for folder, stamp in ((out, 1), (left, 2)):
        folder.mkdir()
        (folder / "frames.jsonl").write_text("")
        _set_time(folder / "frames.jsonl", stamp)
    assert newest(out, "frames.jsonl") == out / "frames.jsonl"


def _set_time(file: Path, seconds: int) -> None:

    os.utime(file, (seconds, seconds))


def test_a_recording_that_may_start_anywhere_cannot_be_viewed(tmp_path):
    write_world(recordings.world_of(recordings.room()), tmp_path / "room.glb")
    more = '\n[[frame]]\ndepth = "0.npy"\n[search]\ninitial = "anywhere"\n'
    (tmp_path / "job.toml").write_text(JOB + more)
    with pytest.raises(TorchcalError, match="expected 'nominal' to view it"):
        Followed.of(read_recording(tmp_path / "job.toml"))


def test_a_hand_held_sensor_with_a_pose_for_each_frame_stands_where_it_was(tmp_path):
    """Frames at their own nominal poses; the correction is that of the first one."""
    write_world(recordings.world_of(recordings.room()), tmp_path / "room.glb")
    frames = "".join(
        f'\n[[frame]]\ndepth = "{k}.npy"\npose = {{ xyz = [0.1, {k}.0, 0.0] }}\n' for k in range(2)
    )
    (tmp_path / "job.toml").write_text(JOB + frames)
    followed = Followed.of(read_recording(tmp_path / "job.toml"))
    names = followed.parameters.names
    values = [0.01, 0.0, 0.0, 0.0, 0.0, 0.1]
    line = {
        "name": "1",
        "status": "unusable",
        "corrections": {name: {"value": v} for name, v in zip(names, values, strict=True)},
        "covariance": torch.eye(6).tolist(),
    }
    place = followed.place(followed.passed(1, line))
    T_first, T_second = pose(0.1, 0, 0, 0, 0, 0), pose(0.1, 1, 0, 0, 0, 0)
    xi = torch.tensor(values, dtype=torch.float64)
    expected = T_first @ se3.exp(xi) @ se3.inverse(T_first) @ T_second
    torch.testing.assert_close(place.T_world_sensor, expected)
