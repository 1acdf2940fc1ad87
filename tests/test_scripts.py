"""Every script can be asked what it does, and needs no more than any program can have."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPTS = sorted((Path(__file__).resolve().parents[1] / "scripts").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS, ids=lambda script: script.name)
def test_a_script_answers_help(script: Path):
    answer = subprocess.run(
        [sys.executable, str(script), "--help"], capture_output=True, text=True, check=False
    )
    assert answer.returncode == 0, answer.stderr
    assert "usage" in answer.stdout.lower()
    assert not answer.stderr


def test_there_are_scripts():
    assert SCRIPTS


INSIDE = {
    ("operator_experiment.py", "torchcal.calibrate.update"),
    ("make_robots.py", "torchcal.model.meshes"),
    ("make_view_picture.py", "torchcal.display.view.app"),
    ("make_view_picture.py", "torchcal.display.view.source"),
    ("fleet.py", "torchcal.fleet.processes"),
}
"""What is measured or used there is a part that has no public name: see ARCHITECTURE.md."""


def test_scripts_use_what_is_public():
    used = {
        (script.name, node.module or "")
        for script in SCRIPTS[0].parent.rglob("*.py")
        for node in ast.walk(ast.parse(script.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torchcal.")
    }
    assert {each for each in used if not each[1].startswith("torchcal.demo")} == INSIDE
