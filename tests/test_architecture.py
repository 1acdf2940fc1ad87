"""The budgets and habits that keep the code small: see CONTRIBUTING.md."""

import ast
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

import torchcal

ROOT = Path(__file__).resolve().parents[1]
LIBRARY = sorted((ROOT / "torchcal").rglob("*.py"))
SOURCES = [
    *LIBRARY,
    *sorted((ROOT / "tests").glob("*.py")),
    *sorted((ROOT / "scripts").glob("*.py")),
]
ROOMS = {
    "cli",
    "demo",
    "display",
    "fleet",
    "calibrate",
    "render",
    "match",
    "solve",
    "model",
    "geometry",
}
FILE_LINES, FUNCTION_LINES = 300, 50

Function = ast.FunctionDef | ast.AsyncFunctionDef


def name(file: Path) -> str:
    return str(file.relative_to(ROOT))


def functions(tree: ast.AST) -> Iterator[Function]:
    return (node for node in ast.walk(tree) if isinstance(node, Function))


def code_lines(function: Function) -> int:
    """Lines of the body, without its docstring."""
    first = 1 if ast.get_docstring(function) else 0
    body = function.body[first:]
    return (body[-1].end_lineno or 0) - body[0].lineno + 1 if body else 0


def public_definitions(tree: ast.Module) -> Iterator[tuple[str, Function | ast.ClassDef]]:
    """Public functions and classes of a module, and the public methods of its public classes."""
    for node in tree.body:
        if isinstance(node, Function | ast.ClassDef) and not node.name.startswith("_"):
            yield node.name, node
            members = node.body if isinstance(node, ast.ClassDef) else []
            for member in members:
                if isinstance(member, Function) and not member.name.startswith("_"):
                    yield f"{node.name}.{member.name}", member


@pytest.mark.parametrize("file", SOURCES, ids=name)
def test_a_file_fits_on_a_few_screens(file: Path):
    assert len(file.read_text().splitlines()) <= FILE_LINES


@pytest.mark.parametrize("file", SOURCES, ids=name)
def test_a_function_fits_on_one_screen(file: Path):
    tree = ast.parse(file.read_text())
    long = {f.name: code_lines(f) for f in functions(tree) if code_lines(f) > FUNCTION_LINES}
    assert not long


@pytest.mark.parametrize("file", LIBRARY, ids=name)
def test_public_names_say_what_they_are(file: Path):
    definitions = public_definitions(ast.parse(file.read_text()))
    silent = [name for name, node in definitions if not ast.get_docstring(node)]
    assert not silent


@pytest.mark.parametrize("file", LIBRARY, ids=name)
def test_nothing_is_left_for_later(file: Path):
    words = [word for word in ("TODO", "FIXME", "XXX") if word in file.read_text()]
    assert not words


def test_the_library_never_prints():
    calls = [
        f"{name(file)}:{node.lineno}"
        for file in LIBRARY
        if "cli" not in file.relative_to(ROOT / "torchcal").parts
        for node in ast.walk(ast.parse(file.read_text()))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("print", "breakpoint")
    ]
    assert not calls


def test_every_room_is_a_package_and_there_is_no_other():
    assert {file.parent.name for file in (ROOT / "torchcal").glob("*/__init__.py")} == ROOMS


def test_importing_torchcal_loads_no_viewer_and_no_commands():
    # matplotlib is not in the list: pytorch-kinematics imports it.
    unwanted = {"viser", "yourdfpy", "tyro", "rich", "torchcal.cli", "torchcal.display"}
    listed = subprocess.run(
        [sys.executable, "-c", "import torchcal, sys; print(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    ).stdout.split()
    assert "torchcal" in listed
    assert not unwanted.intersection(listed)


def test_the_version_stands_in_pyproject_only():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    assert torchcal.__version__ == stated


def test_the_changelog_has_a_place_for_what_is_not_released():
    assert "\n## [Unreleased]\n" in (ROOT / "CHANGELOG.md").read_text()
