"""No job and no URDF, however broken, ends in anything but an answer or one clear error.

``pytest tests/test_fuzzing.py --hypothesis-profile=long`` tries 10,000 of each.
"""

from collections.abc import Callable
from pathlib import Path

import pytest
import tiny_job
from hypothesis import given
from hypothesis import strategies as st

from torchcal.errors import JobError
from torchcal.model.read_job import read_job
from torchcal.model.robot import load_robot

NUMBERS = st.one_of(
    st.integers(),
    st.floats(),
    st.sampled_from([0, -1, 1, 2**63, 10**400, 1e308, 5e-324, float("nan"), float("inf")]),
)
TEXTS = st.one_of(
    st.text(max_size=20),
    st.sampled_from(["", ".", "..", "/", "a.png", "cell.glb", "arm.urdf", "b.npy", "world", "\0"]),
)
NAMES = ["base", "crate", "elbow", "shoulder", "xyz", "model", "sigma", "pose", "link", "depth"]


def toml(value: object) -> str:
    """A value as TOML spells it."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + "".join(_escaped(letter) for letter in value) + '"'
    if isinstance(value, list):
        return "[" + ", ".join(toml(each) for each in value) + "]"
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{toml(k)} = {toml(v)}" for k, v in value.items()) + " }"
    return str(value)


def _escaped(letter: str) -> str:
    code = ord(letter)
    if 0xD800 <= code < 0xE000:
        return "?"
    plain = letter.isprintable() and letter not in '"\\'
    return letter if plain else f"\\U{code:08x}"


VALUES = st.recursive(
    st.one_of(NUMBERS, TEXTS, st.booleans()),
    lambda each: st.one_of(
        st.lists(each, max_size=4), st.dictionaries(st.sampled_from(NAMES), each, max_size=3)
    ),
    max_leaves=6,
).map(toml)


@st.composite
def broken_jobs(draw: st.DrawFn) -> str:
    """A job with some lines lost, repeated, or with values that stand elsewhere or nowhere."""
    lines = draw(st.sampled_from([tiny_job.ARM_JOB, tiny_job.TRIPOD_JOB])).splitlines()
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(lines) - 1))
        change = draw(st.sampled_from(["value", "value", "value", "lose", "repeat", "insert"]))
        if change == "lose":
            del lines[at]
        elif change == "repeat":
            lines.insert(draw(st.integers(0, len(lines))), lines[at])
        elif change == "insert":
            lines.insert(at, draw(st.sampled_from(TABLES)))
        else:
            key = lines[at].partition(" = ")[0] or draw(st.sampled_from(NAMES))
            lines[at] = f"{key} = {draw(VALUES)}"
        if not lines:
            break
    return "\n".join(lines)


TABLES = [
    "[unknown.joints]\nsigma_deg = 1\nsigma = 0.01",
    "[unknown.mount]\nposition_sigma = 0.01\nrotation_sigma_deg = 1",
    "[unknown.object.crate]\nposition_sigma = 0.01\nrotation_sigma_deg = 1",
    "[unknown.frames]\nposition_sigma = 0.01\nrotation_sigma_deg = 1",
    "[unknown.range]\noffset_sigma = 0.01\nscale_sigma = 0.01",
    "[search]\ninitial = 'anywhere'\nalpha = 3.0",
    'preset = "laser-scanner"',
    "unit = 1000",
    "[[frame]]",
    "drift = { sigma = 0.1, pixels = 3 }",
]


@st.composite
def broken_urdfs(draw: st.DrawFn) -> str:
    """A URDF with attributes that say something else, and parts lost, repeated or cut off."""
    text = tiny_job.urdf()
    for _ in range(draw(st.integers(1, 4))):
        parts = text.split("<")
        at = draw(st.integers(1, max(1, len(parts) - 1))) % len(parts)
        change = draw(st.sampled_from(["value", "value", "name", "lose", "repeat", "cut"]))
        if change == "lose":
            del parts[at]
        elif change == "repeat":
            parts.insert(draw(st.integers(0, len(parts))), parts[at])
        elif change == "cut":
            parts[at] = parts[at][: draw(st.integers(0, len(parts[at])))]
        else:
            parts[at] = draw(changed(parts[at], change))
        text = "<".join(parts)
    return text


def changed(part: str, what: str) -> st.SearchStrategy[str]:
    """One tag with another value of its first attribute, or with another name."""
    if what == "name":
        names = st.sampled_from(["link", "joint", "robot", "mesh", "sphere", "origin", "limit"])
        return names.map(lambda name: name + part[len(part.split(" ", maxsplit=1)[0]) :])
    before, equals, after = part.partition("=")
    quote = after[:1] or "'"
    end = after[1:].partition(quote)[2]
    values = st.one_of(NUMBERS.map(str), TEXTS, st.sampled_from(["0 0 0", "1 2", "elbow", "tool"]))
    return values.map(lambda value: f"{before}{equals or '='}{quote}{value}{quote}{end}")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("jobs")
    tiny_job.write(folder, tiny_job.ARM_JOB)
    return folder


@given(text=broken_jobs())
def test_a_broken_job_is_read_or_is_one_clear_error(folder: Path, text: str):
    assert_read_or_clear(read_job, folder / "broken.toml", text)


@given(text=broken_urdfs())
def test_a_broken_urdf_is_read_or_is_one_clear_error(folder: Path, text: str):
    assert_read_or_clear(load_robot, folder / "broken.urdf", text)


@given(content=st.binary(max_size=200))
def test_bytes_are_one_clear_error(folder: Path, content: bytes):
    for name, read in (("bytes.toml", read_job), ("bytes.urdf", load_robot)):
        file = folder / name
        file.write_bytes(content)
        with pytest.raises(JobError) as caught:
            read(file)
        assert_clear(caught.value)


def assert_read_or_clear(read: Callable[[Path], object], file: Path, text: str) -> None:
    file.write_text(text, encoding="utf-8", errors="replace")
    try:
        read(file)
    except JobError as error:
        assert_clear(error)


def assert_clear(error: JobError) -> None:
    assert error.found
    assert error.expected
    assert len(str(error)) < 2000
