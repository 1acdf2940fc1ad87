"""Which robot a job belongs to, when it was recorded, and what stands in its row."""

import csv
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType

import fleet_work
import pytest

from torchcal.fleet import table
from torchcal.fleet.table import Row, cells, robot_of, time_of
from torchcal.fleet.task import Correction, Record

CORRECTIONS = {"base.x": Correction(value=0.001, sigma=0.0002, unit="m")}


def record(
    robot: str | None = "arm", corrections: Mapping[str, Correction] = MappingProxyType({})
) -> Record:
    plain = fleet_work.record(fleet_work.task("any", Path("any")))
    return replace(plain, robot=robot, corrections=corrections)


def row(job: str, found: Record | None) -> Row:
    status = "error" if found is None else found.status
    return Row(job=job, file=Path("job.toml"), status=status, message="", attempts=1, record=found)


@pytest.mark.parametrize(
    ("job", "by", "robot"),
    [
        ("monday", None, "arm"),
        ("r1/monday", None, "r1"),
        ("site/r1/monday", None, "site/r1"),
        ("monday/r1", "job", "r1"),
        ("r1/monday", "urdf", "arm"),
        ("monday", "folder", "arm"),
    ],
)
def test_the_robot_is_the_folder_or_the_job_or_the_urdf(job, by, robot):
    assert robot_of(row(job, record()), by) == robot


def test_without_folder_and_urdf_there_is_no_robot():
    assert robot_of(row("monday", record(robot=None)), None) == "no robot"
    assert robot_of(row("monday", None), None) == "no robot"


@pytest.mark.parametrize(
    ("job", "time"),
    [
        ("r1/2026-11-23", "2026-11-23T00:00:00+00:00"),
        ("r1/rosbag2_2026_11_23-10_15_30", "2026-11-23T10:15:30+00:00"),
        ("20261123T1015", "2026-11-23T10:15:00+00:00"),
        ("2026-11-01/2026-11-23", "2026-11-23T00:00:00+00:00"),
        ("2026-11-23/2026-99-99", "2026-11-23T00:00:00+00:00"),
        ("r1/part-123456789012", "2026-01-01T00:00:00+00:00"),
        ("r1/monday", "2026-01-01T00:00:00+00:00"),
    ],
)
def test_the_time_is_the_last_date_of_the_name_or_that_of_the_images(job, time):
    found = time_of(row(job, record()))
    assert found is not None
    assert found.isoformat() == time


def test_a_job_without_date_and_result_has_no_time():
    assert time_of(row("monday", None)) is None


def test_every_row_has_the_columns_of_all_jobs():
    lift = {"joints.lift": Correction(value=-0.5, sigma=0.25, unit="m")}
    rows = [
        row("a", record(corrections=CORRECTIONS)),
        row("b", None),
        row("c", record(corrections=lift)),
    ]
    found = cells(rows, None)
    assert [list(each) for each in found] == [list(found[0])] * 3
    wanted = ("base.x", "base.x.sigma", "joints.lift", "joints.lift.sigma")
    assert [[each[name] for name in wanted] for each in found] == [
        [0.001, 0.0002, None, None],
        [None] * 4,
        [None, None, -0.5, 0.25],
    ]


def test_csv_survives_what_people_write():
    broken = Row(
        job="a",
        file=Path("a, b.toml"),
        status="error",
        message='found "x,\ny"',
        attempts=3,
        record=None,
    )
    read = next(csv.DictReader(table.as_csv(cells([broken], None)).splitlines(keepends=True)))
    assert (read["message"], read["file"], read["usable"]) == (
        'found "x,\ny"',
        "a, b.toml",
        "False",
    )


def test_a_table_is_replaced_as_a_whole(tmp_path):
    file = tmp_path / "fleet.csv"
    file.write_text("old")
    with pytest.raises(UnicodeEncodeError):
        table.write_text("\ud800", file)
    assert file.read_text() == "old"
    table.write_text("new", file)
    assert [path.name for path in tmp_path.iterdir()] == ["fleet.csv"]
