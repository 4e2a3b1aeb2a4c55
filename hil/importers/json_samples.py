"""Samples in JSON to arrays: a line or an object for each, or a list for each quantity.

Also what pandas writes (``orient`` of `DataFrame.to_json`), and lists of lists.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hil.base.safe_input import parse_json, read_text
from hil.importers.document_messages import (
    Number,
    are_numbers,
    nanoseconds_of,
    numbers_of,
    stamp_of,
)
from hil.importers.ros_messages import MessageError

SUFFIXES: Final = (".json", ".jsonl", ".ndjson")
_MAX_BYTES: Final = 1 << 30  # bytes
_NAMELESS: Final = "array"
_INT64_LIMIT: Final = 2**63


class JsonSamples(NamedTuple):
    """Arrays of a file of JSON."""

    arrays: dict[str, NDArray[Any]]
    is_cut: bool  #: whether its last line ends too early, and was left out


def read_json(path: Path) -> JsonSamples:
    """Return the arrays of numbers of a file, by the names of their fields.

    Raises:
        OSError: it cannot be read.
        ValueError: it is not JSON, or its samples have no constant shape.
    """
    text = read_text(path, _MAX_BYTES, or_latin=True).strip("\0 \t\r\n")
    try:
        document = parse_json(text)
    except ValueError as error:
        lines = [line for line in text.splitlines() if line.strip()]
        if len(lines) < 2:
            raise ValueError(f"it is not JSON: {error}") from error
        return _of_lines(lines)
    return JsonSamples(_arrays_of(document), is_cut=False)


def _of_lines(lines: Sequence[str]) -> JsonSamples:
    samples = []
    is_cut = False
    for number, line in enumerate(lines, 1):
        try:
            samples.append(parse_json(line))
        except json.JSONDecodeError as error:
            is_cut = number == len(lines) > 1
            if not is_cut:
                raise ValueError(f"its line {number} is not JSON: {error}") from error
    return JsonSamples(_arrays_of(samples), is_cut)


def _arrays_of(value: Any) -> dict[str, NDArray[Any]]:
    """Return the arrays of a document."""
    if isinstance(value, list) and value and all(isinstance(each, dict) for each in value):
        return _of_samples(value)
    if isinstance(value, list):
        return _of_rows(value, ())
    if not isinstance(value, dict):
        return {}
    if isinstance(value.get("columns"), list) and isinstance(value.get("data"), list):
        return _of_rows(value["data"], tuple(map(str, value["columns"])))
    found = {key: _of_member(_in_order(inner)) for key, inner in value.items()}
    several = sum(bool(arrays) for arrays in found.values()) > 1
    return {
        name if not inner else (f"{name}/{inner}" if several else inner): array
        for name, arrays in found.items()
        for inner, array in arrays.items()
    }


def _in_order(value: Any) -> Any:
    """Return a column of pandas, an object with the rows as keys, as a list."""
    if not isinstance(value, dict) or not value:
        return value
    return list(value.values()) if all(key.isdecimal() for key in value) else value


def _of_member(value: Any) -> dict[str, NDArray[Any]]:
    """Return the arrays of a member of an object, "" for itself."""
    if isinstance(value, dict) or (
        isinstance(value, list) and value and all(isinstance(each, dict) for each in value)
    ):
        return _arrays_of(value)
    if not isinstance(value, list) or len(value) < 2:
        return {}
    if all(isinstance(each, str) for each in value):
        stamps = [nanoseconds_of(each) for each in value]
        return {} if None in stamps else {"": np.array(stamps, np.int64)}
    array = _array(value)
    return {} if array is None else {"": array}


def _of_rows(rows: Sequence[Any], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Return lists of numbers as columns; the first list may be names."""
    if not names and rows and isinstance(rows[0], list) and rows[0]:
        head = rows[0]
        if all(isinstance(cell, str) for cell in head):
            names, rows = head, rows[1:]
    array = _array(rows) if rows else None
    if array is None:
        return {}
    if array.ndim == 2 and len(names) == array.shape[1]:
        return {name: array[:, column] for column, name in enumerate(names)}
    return {_NAMELESS: array}


def _of_samples(samples: Sequence[Mapping[str, Any]]) -> dict[str, NDArray[Any]]:
    """Return the fields of samples, NaN where a sample lacks one."""
    rows = [dict(numbers_of(sample, times=True)) for sample in samples]
    stamps = [stamp_of(sample) for sample in samples]
    columns: dict[str, NDArray[Any]] = {}
    if stamps and all(stamp is not None for stamp in stamps):
        columns["stamp"] = np.array(stamps, np.int64)
    for name in dict.fromkeys(name for row in rows for name in row):
        values = [row.get(name) for row in rows]
        sizes = {len(value) for value in values if isinstance(value, list)}
        if len(sizes) > 1 or (sizes and any(isinstance(v, int | float) for v in values)):
            raise MessageError(f"{name} has lists of different lengths")
        hole = [np.nan] * sizes.pop() if sizes else np.nan
        columns[name] = _typed([hole if value is None else value for value in values])
    return columns


def _array(values: Sequence[Any]) -> NDArray[Any] | None:
    """Return numbers, or lists of numbers of one length, as an array; None of anything else."""
    rows = values if any(isinstance(value, list) for value in values) else [values]
    for row in rows:
        if not isinstance(row, list) or not are_numbers([x for x in row if x is not None]):
            return None
    if rows is values and len({len(row) for row in rows}) > 1:
        raise MessageError("a list has rows of different lengths")
    if rows is not values:
        return _typed([np.nan if value is None else value for value in values])
    return _typed([[np.nan if x is None else x for x in row] for row in rows])


def _typed(values: Sequence[Number | Sequence[Number]]) -> NDArray[Any]:
    """Return whole numbers as integers: a stamp in nanoseconds has too many digits for a double."""
    flat = values if not isinstance(values[0], list) else [x for row in values for x in row]  # type: ignore[union-attr]
    is_whole = all(isinstance(x, int) and abs(x) < _INT64_LIMIT for x in flat)
    return np.array(values, np.int64 if is_whole else np.float64)
