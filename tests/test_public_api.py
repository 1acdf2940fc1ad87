"""What ``import torchcal`` gives, and that the README's example does what it says."""

import inspect
import re
import tomllib
import typing
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from small_demo import write_small_demo

import torchcal
from torchcal.cli.options import COMMANDS
from torchcal.model.job_mistakes import checked

README = Path(__file__).resolve().parents[1] / "README.md"
MADE_BY_CALLS = {
    "Foresight": "foresee",
    "JobCheck": "check",
    "Parameters": "Parameters.of",
    "Recording": "read_recording",
    "Robot": "load_robot",
    "Scene": "build_scene",
    "Site": "Site.of",
    "Tracker": "Tracker.of",
}
"""Classes that nobody makes of their fields."""
WORDS = {"as", "for", "many", "jobs", "of", "a", "job", "then"}
CLOSE = 0.001  # m, rad; five of the standard deviations that so few pixels leave


def public_names() -> list[str]:
    spelled = re.findall(r" as (\w+)$", Path(torchcal.__file__).read_text(), re.MULTILINE)
    return sorted(set(spelled))


def examples(language: str) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", README.read_text(), re.DOTALL)


@pytest.mark.parametrize("name", public_names())
def test_a_public_name_says_what_it_is(name: str):
    assert (getattr(torchcal, name).__doc__ or "").strip()


def test_the_commands_calls_are_public():
    told = re.findall(r"^    torchcal (\w+) +(.*)$", torchcal.__doc__ or "", re.MULTILINE)
    assert [command for command, _ in told] == list(COMMANDS)
    calls = {word for _, words in told for word in re.findall(r"\w+", words)} - WORDS
    assert len(calls) > 8
    assert calls <= set(public_names())


def parts(annotation: object) -> Iterator[type]:
    """The classes of torchcal in an annotation."""
    if isinstance(annotation, type) and annotation.__module__.startswith("torchcal."):
        yield annotation
    for each in typing.get_args(annotation):
        yield from parts(each)


def calls_of(name: str) -> Iterator[Callable]:
    """What a caller may call of a public name: itself, the constructor, the public methods."""
    found = getattr(torchcal, name)
    if not isinstance(found, type):
        yield from [found] if callable(found) else []
        return
    yield from [] if name in MADE_BY_CALLS else [found.__init__]
    members = inspect.getmembers(found, inspect.isroutine)
    yield from (member for key, member in members if not key.startswith("_"))


@pytest.mark.parametrize("name", public_names())
def test_a_caller_can_make_everything_that_a_public_call_takes(name: str):
    hidden = set()
    for call in calls_of(name):
        if (getattr(call, "__module__", None) or "").startswith("torchcal"):
            taken = {k: v for k, v in typing.get_type_hints(call).items() if k != "return"}
            hidden |= {each.__name__ for kind in taken.values() for each in parts(kind)}
    assert hidden <= set(public_names())


@pytest.mark.parametrize("name", sorted(MADE_BY_CALLS))
def test_what_is_made_by_a_call_is(name: str):
    call: object = torchcal
    for part in MADE_BY_CALLS[name].split("."):
        call = getattr(call, part)
    made = typing.get_type_hints(call)["return"]
    assert made in (name, getattr(torchcal, name))


def test_a_name_that_torchcal_does_not_have_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'calibrat'"):
        _ = torchcal.calibrat  # pyright: ignore[reportAttributeAccessIssue]


def test_the_job_file_of_the_readme_has_only_keys_that_a_job_may_have():
    table = checked(README, tomllib.loads(*examples("toml")))
    assert table.world is not None
    assert table.sensor.model == "pinhole"
    assert table.unknown.mount is not None


@pytest.mark.slow
def test_the_example_of_the_readme_prints_the_true_pose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "torchcal-demo").mkdir()
    T_world_base = write_small_demo(tmp_path / "torchcal-demo")
    monkeypatch.chdir(tmp_path)
    exec(compile(examples("python")[0], "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert printed.startswith("converged")
    numbers = {name: float(sigma) for name, sigma in re.findall(r"(base\.\w+) ± ([\d.]+)", printed)}
    assert list(numbers) == [f"base.{axis}" for axis in ("x", "y", "z", "rx", "ry", "rz")]
    assert all(0.0 < sigma < CLOSE for sigma in numbers.values())
    rows = re.findall(r"\[+ *([-\d.e]+), +([-\d.e]+), +([-\d.e]+), +([-\d.e]+)\]", printed)
    found = np.asarray(rows, float)
    np.testing.assert_allclose(found, T_world_base.numpy(), atol=CLOSE)


@pytest.mark.slow
def test_the_readmes_example_frame_by_frame_tracks(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    (tmp_path / "torchcal-demo").mkdir()
    write_small_demo(tmp_path / "torchcal-demo")
    monkeypatch.chdir(tmp_path)
    exec(compile(examples("python")[1], "README.md", "exec"), {})
    lines = capsys.readouterr().out.splitlines()
    assert lines
    assert all(line.startswith("tracking False tensor(") for line in lines)


def test_the_readmes_example_with_points_finds_where_they_were_moved(
    capsys: pytest.CaptureFixture[str],
):
    code = examples("python")[2]
    names: dict[str, object] = {}
    exec(compile(code, "README.md", "exec"), names)
    poses = names["poses"]
    assert isinstance(poses, torchcal.ElementPoses)
    converged = poses.status == torchcal.ElementStatus.CONVERGED
    assert int(converged.sum()) > 900
    moved = poses.T_measured_model[converged]
    expected = torch.eye(4, dtype=torch.float64)
    expected[:3, 3] = 5.0
    # Millimetres of noise on points within a metre of each other.
    assert float((moved - expected).abs().flatten(1).amax(1).median()) < 0.01
    assert "tensor" in capsys.readouterr().out
