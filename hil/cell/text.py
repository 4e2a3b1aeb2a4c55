"""Changing a value in the text of a TOML file."""

from __future__ import annotations

import re


def replaced_value(text: str, table: str, key: str, value: float | str) -> str:
    """The TOML `text` with `key` of `[table]` set to `value`; comments and order stay.

    Raises:
        ValueError: there is no such table.
    """
    header = rf"^\[{table}\][ \t]*(?:#[^\n]*)?$"
    found = re.search(header, text, re.MULTILINE)
    if found is None:
        raise ValueError(f"there is no table [{table}]")
    start = found.end()
    following = re.search(r"^\[", text[start:], re.MULTILINE)
    end = start + following.start() if following else len(text)
    body, count = re.subn(
        rf"(?m)^({key} *= *)(?:\"[^\"\n]*\"|[^\n#]*)", rf"\g<1>{value}", text[start:end], count=1
    )
    if not count:
        body = f"\n{key} = {value}{text[start:end]}"
    return text[:start] + body + text[end:]
