"""Changing a value in the text of a TOML file."""

from __future__ import annotations

import re

from hil.errors import InputError


class NoTableError(InputError, ValueError):
    """A table that is to be changed is not written as one, with its name in a line of its own."""

    def __init__(self, table: str) -> None:
        super().__init__(
            None,
            f"there is no table [{table}] in the cell file, or not as a header",
            remedy=f"write [{table}] in a line of its own, and its entries below",
        )


def replaced_value(text: str, table: str, key: str, value: float | str) -> str:
    """The TOML `text` with `key` of `[table]` set to `value`; comments and order stay.

    Raises:
        NoTableError: there is no such table.
    """
    header = rf"^[ \t]*\[[ \t]*{table}[ \t]*\][ \t]*(?:#[^\n]*)?$"
    found = re.search(header, text, re.MULTILINE)
    if found is None:
        raise NoTableError(table.replace("\\.", "."))
    start = found.end()
    following = re.search(r"^[ \t]*\[", text[start:], re.MULTILINE)
    end = start + following.start() if following else len(text)
    # A list may go over several lines, and may hold lists.
    a_list = r"\[(?:[^\[\]]|\[[^\[\]]*\])*\]"
    setting = rf"(?m)^([ \t]*{key}[ \t]*=[ \t]*)(?:\"[^\"\n]*\"|{a_list}|[^\n#]*)"
    body, count = re.subn(setting, lambda match: f"{match[1]}{value}", text[start:end], count=1)
    if not count:
        body = f"\n{key} = {value}{text[start:end]}"
    return text[:start] + body + text[end:]
