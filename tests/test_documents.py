"""What README and ARCHITECTURE name is there."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCUMENTS = ("README.md", "ARCHITECTURE.md")


def words(document: str) -> str:
    """A document without its blocks of code."""
    return re.sub(r"^```.*?^```", "", (ROOT / document).read_text(), flags=re.DOTALL | re.MULTILINE)


def references(document: str) -> list[tuple[str, str]]:
    """The modules that a document names, each with the name in it or an empty text."""
    quoted = re.findall(r"`([^`]+)`", words(document))
    found = [re.search(r"([\w/]+\.py)(?:: ([\w.]+))?", text) for text in quoted]
    return sorted({(each[1], each[2] or "") for each in found if each is not None})


def files(path: str) -> list[Path]:
    """The files that a reader finds under a path, or under its last part where that is enough."""
    own = ROOT / path
    return [own] if own.is_file() else sorted((ROOT / "torchcal").rglob(path))


def defined(body: list[ast.stmt], owner: str = "") -> Iterator[str]:
    """Names that statements define, and those of classes in them."""
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield owner + node.name
        if isinstance(node, ast.ClassDef):
            yield from defined(node.body, f"{node.name}.")
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        yield from (owner + each.id for each in targets if isinstance(each, ast.Name))


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_module_and_definition_that_is_named_is_there(document: str):
    named = references(document)
    assert len(named) > 30
    lost = [
        f"{path}: {name}"
        for path, name in named
        if not any(
            not name or name in defined(ast.parse(file.read_text()).body) for file in files(path)
        )
    ]
    assert not lost


@pytest.mark.parametrize("document", DOCUMENTS)
def test_every_file_that_is_linked_is_there(document: str):
    links = re.findall(r"\]\(([^)#]+)", words(document))
    lost = [link for link in links if "://" not in link and not (ROOT / link).exists()]
    assert not lost
