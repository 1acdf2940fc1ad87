"""From a parsed job file to its checked tables: the first mistake in one sentence for a person."""

import json
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from torchcal.errors import JobError, choices
from torchcal.model.job_schema import JobTable, Table

_NOTHING = object()


def checked(file: Path, raw: dict[str, Any]) -> JobTable:
    """The tables of a job file.

    Args:
        file: The job file, for the message of an error.
        raw: What the file holds.

    Raises:
        JobError: If a key is unknown, missing, of the wrong type or out of its limits.
    """
    try:
        return JobTable.model_validate(raw)
    except ValidationError as error:
        mistakes = error.errors(include_url=False)
    unknown = [mistake for mistake in mistakes if mistake["type"] == "extra_forbidden"]
    raise _job_error(file, raw, (unknown or mistakes)[0])


def among(name: str, names: tuple[str, ...]) -> str:
    """The possible names for an error message, the one that was probably meant first."""
    close = get_close_matches(name, names, n=1)
    return f"{close[0]} (the closest), {choices(names)}" if close else choices(names)


def shown(value: object) -> str:
    """A value of the job file as its author wrote it, or nearly."""
    if value is _NOTHING:
        return "nothing"
    if isinstance(value, dict):
        return "a table with " + (", ".join(value) or "nothing")
    if isinstance(value, list) and any(isinstance(item, dict) for item in value):
        return f"a list of {len(value)} tables"
    if isinstance(value, list):
        text = f"[{', '.join(map(shown, value))}]"
    elif isinstance(value, str | bool):
        text = json.dumps(value, ensure_ascii=False)
    else:
        text = str(value)
    return text if len(text) <= 80 else text[:77] + "..."


@dataclass(frozen=True, kw_only=True, slots=True)
class _Place:
    """A key of the job file, what stands there and what may stand there."""

    key: str
    value: object
    expected: str
    table: type[Table] | None


def _job_error(file: Path, raw: dict[str, Any], mistake: Any) -> JobError:
    place = _Place(key="", value=raw, expected="the tables of a job", table=JobTable)
    for step in mistake["loc"]:
        if not _is_container(place.value, step):
            break
        place = _enter(place, step)
    if mistake["type"] == "extra_forbidden" and place.table is not None:
        name = str(mistake["loc"][-1])
        return JobError(
            file, place.key, "an unknown key", among(name, tuple(place.table.model_fields))
        )
    return JobError(file, place.key, shown(place.value), place.expected)


def _is_container(value: object, step: str | int) -> bool:
    """Whether the step leads to a key of its own and not into a list of numbers."""
    if isinstance(step, str):
        return isinstance(value, dict)
    return isinstance(value, list) and step < len(value) and isinstance(value[step], dict)


def _enter(place: _Place, step: str | int) -> _Place:
    value: Any = place.value
    if isinstance(step, int):
        key, inside = f"{place.key}[{step + 1}]", value[step]
    else:
        key, inside = f"{place.key}.{step}".lstrip("."), value.get(step, _NOTHING)
    fields = place.table.model_fields if place.table else {}
    field = fields.get(str(step))
    if field is None:
        return _Place(key=key, value=inside, expected=place.expected, table=place.table)
    expected = field.description or "another value"
    return _Place(key=key, value=inside, expected=expected, table=_table_in(field.annotation))


def _table_in(annotation: Any) -> type[Table] | None:
    """The table that a field, or each element of it, holds."""
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return annotation
    found = (_table_in(inner) for inner in get_args(annotation))
    return next((table for table in found if table is not None), None)
