"""What is written as a job file is what was meant, whatever its names are."""

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from torchcal.errors import JobError
from torchcal.model.write_job import key, write_job


def tables(**more: Any) -> dict[str, Any]:
    return {
        "world": {"model": "cell.glb", "complete": True},
        "sensor": {
            "model": "pinhole",
            "width": 8,
            "height": 6,
            "fx": 9.0,
            "fy": 9.5,
            "cx": 3.5,
            "cy": 2.5,
            "range": [0.3, 4.0],
            "sigma": 0.01,
        },
        "frame": [
            {"depth": "a.png", "pose": {"xyz": [1, 2, 3], "rpy_deg": [0.0, 90.0, 1e-17]}},
            {"depth": "b.png", "pose": {"xyz": [0.0, 0.0, 0.0]}},
        ],
        "unknown": {
            "base": {"position_sigma": 0.1, "rotation_sigma_deg": [1.0, 0.0, 2.0]},
            "object": {"a crate.001": {"position_sigma": 0.1, "rotation_sigma_deg": 5.0}},
        },
        **more,
    }


def test_the_file_holds_the_tables(tmp_path: Path):
    file = tmp_path / "job.toml"
    write_job(file, tables())
    assert tomllib.loads(file.read_text()) == tables()


def test_remarks_and_heading_are_comments(tmp_path: Path):
    file = tmp_path / "job.toml"
    remarks = {"sensor": "the camera", "sensor.sigma": "a guess", "frame.pose": "unknown"}
    write_job(file, tables(), heading=["two", "", "lines"], remarks=remarks)
    text = file.read_text()
    assert text.startswith("# two\n#\n# lines\n\n[world]")
    assert "# the camera\n[sensor]\n" in text
    assert "sigma = 0.01  # a guess\n" in text
    assert text.count("# unknown") == 1
    assert tomllib.loads(text) == tables()


def test_numbers_keep_all_their_digits(tmp_path: Path):
    file = tmp_path / "job.toml"
    number = 0.1 + 0.2
    write_job(file, tables(search={"alpha": np.float64(number)}))
    assert tomllib.loads(file.read_text())["search"]["alpha"] == number


@pytest.mark.parametrize("wrong", [{"sensors": {}}, {"search": {"alpha": "three"}}])
def test_what_a_job_may_not_hold_is_not_written(tmp_path: Path, wrong: dict[str, Any]):
    file = tmp_path / "job.toml"
    with pytest.raises(JobError):
        write_job(file, tables(**wrong))
    assert not file.exists()


@given(st.text(st.characters(exclude_categories=["Cs"])))
def test_any_name_is_a_key(name: str):
    assert tomllib.loads(f"{key(name)} = 1") == {name: 1}
