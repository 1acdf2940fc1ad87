"""The report of a result after decisions: it says them, and nothing else of it changes."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from display_scene import calibration

from torchcal.cli.output import foreign_file
from torchcal.cli.result_files import write_results
from torchcal.display.decided import BEGIN, END, decide


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_results(calibration(), tmp_path / "out")
    return tmp_path / "out"


def words_of(folder: Path) -> str:
    return re.sub(r"<[^>]*>|\s+", " ", (folder / "report.html").read_text(encoding="utf-8"))


def test_the_report_says_what_was_decided_and_else_stays_as_it_was(folder):
    before = (folder / "report.html").read_text(encoding="utf-8")
    assert "2 proposed, nothing is decided yet" in words_of(folder)
    decide(folder, accept=["crate"])
    assert "1 accepted, 1 not decided" in words_of(folder)
    decide(folder, reject=["added-1"])
    assert "1 accepted, 1 rejected, nothing left to decide" in words_of(folder)
    assert re.search(r"✔ accepted +remove +crate", words_of(folder))
    assert re.search(r"✘ rejected +add +added-1", words_of(folder))
    after = (folder / "report.html").read_text(encoding="utf-8")
    assert after.partition(BEGIN)[0] == before.partition(BEGIN)[0]
    assert after.partition(END)[2] == before.partition(END)[2]
    assert foreign_file(folder) is None


def test_a_name_cannot_end_the_part_of_the_report_that_changes(tmp_path):
    whole = calibration()
    (added,) = whole.update.added
    update = replace(whole.update, added=(replace(added, name=END),))
    write_results(replace(whole, update=update), tmp_path / "out")
    decide(tmp_path / "out", reject=[END])
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count(END) == page.count(BEGIN) == 1


@pytest.mark.parametrize("page", [None, "my own page", b"\xff"])
def test_a_report_that_is_gone_or_another_is_no_error_and_stays(folder, page):
    file = folder / "report.html"
    file.unlink()
    if page is not None:
        file.write_bytes(page if isinstance(page, bytes) else page.encode())
    decide(folder, reject=["all"])
    assert file.exists() == (page is not None)
    assert page is None or BEGIN.encode() not in file.read_bytes()
