"""Changes of entries in the text of a TOML file."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import tomlkit
from tomlkit.exceptions import TOMLKitError
from tomlkit.items import Array as List
from tomlkit.items import Item, Table

from hil.base.errors import InputError
from hil.base.safe_input import parse_toml
from hil.base.toml_text import inline


def with_values(text: str, values: Mapping[str, Any]) -> str:
    """Set values in a TOML text, such as ``{"campaign.repetitions": 3}``; None changes nothing.

    Comments, order and layout of all else are preserved, in a list of the same length also those
    between its entries; missing tables and entries are added.

    Raises:
        TypeError: a value is of a type that TOML does not have.
        InputError: the layout of the text is one that tomlkit does not preserve.
    """
    given = {name: inline(value) for name, value in values.items() if value is not None}
    try:
        changed = _edited(text, given)
        preserved = _others(changed, given) == _others(text, given)  # an arm's limits among them
    except (TOMLKitError, ValueError):
        preserved = False
    if not preserved:
        raise InputError(
            None,
            f"{', '.join(given)} cannot be changed in this text without changing other entries",
            remedy="write each table once, below a header line [table] of its own",
        )
    return changed


def _edited(text: str, values: Mapping[str, Item]) -> str:
    document = tomlkit.parse(text)
    for name, value in values.items():
        *path, key = name.split(".")
        table: Any = document
        for part in path:
            if part not in table:
                table[part] = tomlkit.table()
            table = table[part]
        _set(table, key, value)
    return tomlkit.dumps(document)


def _set(table: Any, key: str, value: Item) -> None:
    """Set an entry of a table of a parsed text."""
    if key not in table:
        _append(table, key, value)
        return
    present = table[key]
    if isinstance(present, List) and isinstance(value, List) and len(present) == len(value):
        for index, entry in enumerate(value):
            present[index] = inline(entry)
    else:
        table[key] = value


def _append(table: Any, key: str, value: Item) -> None:
    """Add an entry in front of the comments at the end of a table: they belong to what follows."""
    end = []
    if isinstance(table, Table):
        body = table.value.body
        while body and body[-1][0] is None:
            end.append(body.pop()[1])
    table[key] = value
    for item in reversed(end):
        table.value.add(item)


def _others(text: str, changed: Mapping[str, Any]) -> dict[str, str]:
    """Return the entries of a text by dotted name, except below a changed name."""
    return {
        name: entry
        for name, entry in _entries(parse_toml(text), "")
        if not any(f"{name}.".startswith(f"{other}.") for other in changed)
    }


def _entries(table: Mapping[str, Any], path: str) -> Iterator[tuple[str, str]]:
    for name, value in table.items():
        if isinstance(value, Mapping):
            yield from _entries(value, f"{path}{name}.")
        else:
            yield f"{path}{name}", repr(value)
