"""The tables of results as CSV, in full precision: every list of records, every matrix."""

from __future__ import annotations

import csv
from collections.abc import Iterator
from io import StringIO
from typing import Any

from hil.results import Results


def csv_tables(results: Results) -> dict[str, str]:
    """The text of each table, by file name: the path of its field in `results.json`.

    A list with a number for each joint has a column for each, `field.joint`; a matrix with a
    column for each parameter has their names. What is neither stays in `results.json`.
    """
    fields = results.model_dump(mode="json")
    names = [parameter["name"] for parameter in fields["parameters"]]
    tables = {}
    for path, rows in _lists(fields, ""):
        if isinstance(rows[0], dict):
            records = [dict(_cells(row, fields["joint_names"])) for row in rows]
        else:
            heads = names if len(rows[0]) == len(names) else range(len(rows[0]))
            records = [dict(zip(map(str, heads), row, strict=True)) for row in rows]
        text = StringIO()
        columns = dict.fromkeys(key for row in records for key in row)
        writer = csv.DictWriter(text, list(columns), lineterminator="\n")
        writer.writeheader()
        writer.writerows(records)
        tables[f"{path}.csv"] = text.getvalue()
    return tables


def _lists(value: dict[str, Any], path: str) -> Iterator[tuple[str, list[Any]]]:
    """Lists of records and of rows of equal length, however deep, and where they are."""
    for name, item in value.items():
        if isinstance(item, dict):
            yield from _lists(item, f"{path}{name}.")
        elif isinstance(item, list) and item:
            records = all(isinstance(row, dict) for row in item)
            matrix = all(isinstance(row, list) and len(row) == len(item[0]) > 0 for row in item)
            if records or matrix:
                yield f"{path}{name}", item


def _cells(record: dict[str, Any], joints: list[str]) -> Iterator[tuple[str, Any]]:
    for name, item in record.items():
        if not isinstance(item, list | dict):
            yield name, item
        elif isinstance(item, list) and len(item) == len(joints):
            yield from ((f"{name}.{joint}", cell) for joint, cell in zip(joints, item, strict=True))
