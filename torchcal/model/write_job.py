"""Writing a job file: TOML with a remark before each table or key that a person should look at."""

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torchcal.model.job_mistakes import checked

_BARE_KEY = re.compile(r"[A-Za-z0-9_-]+")


def write_job(
    file: Path,
    tables: Mapping[str, Any],
    *,
    heading: Sequence[str] = (),
    remarks: Mapping[str, str] | None = None,
) -> None:
    """Writes a job file; what stands in it was checked as ``read_job`` checks keys and values.

    Args:
        file: The TOML file; the folder must be there.
        tables: The job as nested tables, in the keys of a job file; ``frame`` is a list.
        heading: Lines of comment at the top of the file.
        remarks: Comments for tables (``sensor``, before them) and keys (``sensor.sigma``, after
            them).

    Raises:
        JobError: If a key is unknown, missing, of the wrong type or out of its limits.
    """
    checked(file, dict(tables))
    comments = "".join(f"# {line}".rstrip() + "\n" for line in heading)
    body = "\n".join(_sections(tables, remarks or {}))
    file.write_text(comments + ("\n" if comments else "") + body, encoding="utf-8")


def key(name: str) -> str:
    """A name as a key of TOML: in quotes where it has to be."""
    return name if _BARE_KEY.fullmatch(name) else _text(name)


def _sections(tables: Mapping[str, Any], remarks: Mapping[str, str]) -> Iterator[str]:
    for name, content in tables.items():
        if isinstance(content, Mapping):
            yield from _table(name, content, remarks)
        else:
            for number, each in enumerate(content):
                said = remarks if number == 0 else {}
                yield _section(f"[[{key(name)}]]", name, each, said)


def _table(path: str, content: Mapping[str, Any], remarks: Mapping[str, str]) -> Iterator[str]:
    """One table, or those inside it where it holds nothing but tables."""
    if content and all(isinstance(value, Mapping) for value in content.values()):
        for name, inner in content.items():
            yield from _table(f"{path}.{key(name)}", inner, remarks)
    else:
        yield _section(f"[{path}]", path, content, remarks)


def _section(header: str, path: str, content: Mapping[str, Any], remarks: Mapping[str, str]) -> str:
    before = [f"# {remarks[path]}"] if path in remarks else []
    lines = [
        f"{key(name)} = {_value(value)}" + _after(remarks.get(f"{path}.{name}"))
        for name, value in content.items()
    ]
    return "\n".join([*before, header, *lines]) + "\n"


def _after(remark: str | None) -> str:
    return f"  # {remark}" if remark else ""


def _value(value: object) -> str:
    if isinstance(value, Mapping):
        inside = ", ".join(f"{key(str(name))} = {_value(each)}" for name, each in value.items())
        return f"{{ {inside} }}"
    if isinstance(value, str):
        return _text(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Sequence):
        return f"[{', '.join(map(_value, value))}]"
    return repr(float(value)) if isinstance(value, float) else str(value)


def _text(text: str) -> str:
    """A basic string of TOML: that of JSON, which leaves one control character as it is."""
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")
