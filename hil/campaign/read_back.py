"""What a step of a campaign wrote down, read back as it was, or refused in a sentence."""

from __future__ import annotations

from typing import TypeVar

from pydantic import TypeAdapter, ValidationError

T = TypeVar("T")


def read_back(kind: type[T], text: str, *, strict: bool = True) -> T:
    """An object of a dataclass or model, from the JSON that its fields were written as.

    Args:
        kind: of the object.
        text: the JSON.
        strict: numbers are no texts. If not, each field is as strict as it says itself: a model
            writes infinite numbers as words.

    Raises:
        ValueError: it is no JSON, or a field is not what it has to be; names the first one.
    """
    try:
        return TypeAdapter(kind).validate_json(text, strict=strict or None)
    except ValidationError as error:
        raise ValueError(first_of(error)) from error


def first_of(error: ValidationError) -> str:
    """The first thing that is wrong, with its place."""
    first = error.errors()[0]
    place = ".".join(map(str, first["loc"]))
    return f"{place}: {first['msg']}" if place else str(first["msg"])
