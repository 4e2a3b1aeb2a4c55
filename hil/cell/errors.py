"""What a bad cell file gets: one sentence with file, field, value and remedy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, get_args

from pydantic import BaseModel, ValidationError

from hil.errors import InputError


class CellError(InputError):
    """The cell file cannot be used.

    Attributes:
        path: the file.
        field: dotted name of the field, or "" for the file as a whole.
        value: what stood there (None if nothing did).
    """

    def __init__(self, path: Path, field: str, value: object, problem: str, remedy: str) -> None:
        self.value = value
        found = "" if value is None else f" = {_short(value)}"
        super().__init__(path, problem, field=f"{field}{found}", remedy=remedy)
        self.field = field


def first_error(path: Path, error: ValidationError, schema: type[BaseModel]) -> CellError:
    """The first complaint of pydantic, in our words."""
    detail = error.errors(include_url=False)[0]
    location = [part for part in detail["loc"] if not _is_union_tag(part)]
    field = _dotted(_walk(schema, location).fields)
    if detail["type"].startswith("union_tag"):
        return _kind_error(path, field, detail, described(schema, location))
    if detail["type"] == "missing":
        return CellError(path, field, None, "is missing", f"add it: {described(schema, location)}")
    if detail["type"] == "extra_forbidden":
        known = ", ".join(sorted(_fields_at(schema, location[:-1])))
        return CellError(
            path, field, detail["input"], "is not a field that is known here", f"known are: {known}"
        )
    value = None if isinstance(detail["input"], dict) else detail["input"]
    problem, _, remedy = detail["msg"].removeprefix("Value error, ").partition("; ")
    remedy = remedy or f"it must be {described(schema, location)}"
    return CellError(path, field, value, problem[0].lower() + problem[1:], remedy)


def _dotted(location: list[Any]) -> str:
    text = ""
    for part in location:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def _is_union_tag(part: object) -> bool:
    return isinstance(part, str) and ("[" in part or part in {"none", "str", "list", "float"})


class _Place(NamedTuple):
    """Where a location leads in a schema.

    Attributes:
        model: that of the table there, None where there is none.
        description: of the last named field on the way.
        fields: the location without the kinds of table that pydantic adds to it.
    """

    model: type[BaseModel] | None
    description: str
    fields: list[Any]


def _walk(schema: type[BaseModel], location: list[Any]) -> _Place:
    models, description = [schema], "as the documentation of the cell file says"
    fields = []
    for part in location:
        if (one := _of_kind(models, part)) is not None:
            models = [one]
            continue
        fields.append(part)
        if models and part in models[0].model_fields:
            info = models[0].model_fields[part]
            description = info.description or f"a table [{part}]"
            models = list(_models_of(info.annotation))
    return _Place(models[0] if models else None, description, fields)


def _models_of(annotation: Any) -> Iterator[type[BaseModel]]:
    """Every model within an annotation, such as those of a list of several kinds."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        yield annotation
    for part in get_args(annotation):
        yield from _models_of(part)


def _of_kind(models: list[type[BaseModel]], part: object) -> type[BaseModel] | None:
    """That of several models whose `kind` is `part`; None where this names no kind."""
    for model in models:
        kind = model.model_fields.get("kind")
        if kind is not None and part in get_args(kind.annotation):
            return model
    return None


def _kind_error(path: Path, field: str, detail: Any, remedy: str) -> CellError:
    """An entry of a list of several kinds that is of none of them."""
    given = detail["input"].get("kind") if isinstance(detail["input"], dict) else None
    problem = "is missing" if given is None else "is not a kind that is known here"
    return CellError(path, f"{field}.kind", given, problem, f"the list must be {remedy}")


def described(schema: type[BaseModel], location: list[Any]) -> str:
    """What the value at `location` must be, in the words of the schema."""
    return _walk(schema, location).description


def _fields_at(schema: type[BaseModel], location: list[Any]) -> list[str]:
    model = _walk(schema, location).model
    return list(model.model_fields) if model else []


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
