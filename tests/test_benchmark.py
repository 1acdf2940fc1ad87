"""The measurements beside other programs write a report that says what ran."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"
OTHER = "## render\n\nA machine.\n\n| a | b |\n| --- | --- |\n| 1 | 2 |\n"
"""Another measurement's section."""
WITHOUT_OPEN3D = """
import runpy, sys
sys.modules["open3d"] = None
sys.argv = sys.argv[1:]
sys.path.insert(0, {scripts!r})
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def measured(out: Path, *, seed: int = 0) -> str:
    """The report of a tiny run without Open3D."""
    options = ["--trials", "6", "--scipy-trials", "2", "--rounds", "2", "--seed", str(seed)]
    program = WITHOUT_OPEN3D.format(scripts=str(SCRIPTS))
    command = [sys.executable, "-c", program, str(SCRIPTS / "benchmark.py"), "solver"]
    answer = subprocess.run(
        [*command, *options, "--out", str(out)], capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stderr
    return out.read_text()


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> str:
    out = tmp_path_factory.mktemp("report") / "benchmarks.md"
    out.write_text(f"# Benchmarks\n\n{OTHER}")
    return measured(out)


def rows(report: str, program: str) -> list[list[str]]:
    """The cells of a program's rows, without its name."""
    lines = [line for line in report.splitlines() if line.startswith(f"| {program}")]
    return [[cell.strip() for cell in line.strip("|").split("|")][1:] for line in lines]


def test_every_protocol_has_a_table(report: str):
    assert re.findall("^### (.*)", report, re.MULTILINE) == ["all-pairs", "one-to-one"]


def test_torchcal_solves_all_trials_and_is_the_unit_of_the_ratios(report: str):
    found = rows(report, "torchcal")
    assert [(cells[0], cells[1], cells[-1]) for cells in found] == [("6", "100.0%", "1")] * 2


def test_a_program_on_fewer_trials_says_so(report: str):
    found = rows(report, "SciPy")
    assert [cells[0] for cells in found] == ["2", "2"]
    assert all(float(cells[-2]) > 0 for cells in found)


def test_a_program_that_is_not_installed_is_said_to_be_missing(report: str):
    lines = [line for line in report.splitlines() if line.startswith("| Open3D")]
    assert len(lines) == 6
    assert all("missing" in line and line.count("| -") == 6 for line in lines)


def test_other_sections_stay_as_they_were(report: str):
    assert OTHER in report
    assert report.index("## render") < report.index("## solver")


def test_a_section_names_the_machine(report: str):
    section = report.split("## solver\n\n")[1]
    assert re.match(r"\S.*, \d+ cores, torch \S+, \d{4}-\d\d-\d\d\n", section)
