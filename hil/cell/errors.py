"""What a bad cell file gets: one sentence with file, field, value and remedy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

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
    field = _dotted(location)
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


def _walk(schema: type[BaseModel], location: list[Any]) -> tuple[type[BaseModel] | None, str]:
    """The model at `location` and the description of the last named field on the way."""
    model: type[BaseModel] | None = schema
    description = "as the documentation of the cell file says"
    for part in location:
        if isinstance(part, int) or model is None or part not in model.model_fields:
            continue
        info = model.model_fields[part]
        description = info.description or f"a table [{part}]"
        model = _model_of(info.annotation)
    return model, description


def _model_of(annotation: Any) -> type[BaseModel] | None:
    for candidate in (annotation, *getattr(annotation, "__args__", ())):
        if isinstance(candidate, type) and issubclass(candidate, BaseModel):
            return candidate
    return None


def described(schema: type[BaseModel], location: list[Any]) -> str:
    """What the value at `location` must be, in the words of the schema."""
    return _walk(schema, location)[1]


def _fields_at(schema: type[BaseModel], location: list[Any]) -> list[str]:
    model = _walk(schema, location)[0]
    return list(model.model_fields) if model else []


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
