"""Single values as TOML, to the last bit: what every writer of a TOML text of ours is made of."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from datetime import date, time
from typing import Any


def toml_key(name: str) -> str:
    """Return a key, quoted where it has to be."""
    bare = name and all(c.isascii() and (c.isalnum() or c in "_-") for c in name)
    return name if bare else toml_text(name)


def toml_text(value: str) -> str:
    """Return a text in quotes."""
    # JSON's quoting, but for what TOML wants otherwise: no pairs of surrogates, no bare DEL.
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def toml_value(value: Any) -> str:
    """Return a number, text, truth value, date, time, list or table (inline) of these.

    Raises:
        TypeError: it is something else.
    """
    if isinstance(value, float):
        return repr(float(value)) if math.isfinite(value) else str(float(value))  # inf, -inf, nan
    if isinstance(value, str):
        return toml_text(value)
    if isinstance(value, Mapping):
        entries = (f"{toml_key(name)} = {toml_value(entry)}" for name, entry in value.items())
        return f"{{ {', '.join(entries)} }}"
    if isinstance(value, Sequence):
        return f"[{', '.join(toml_value(entry) for entry in value)}]"
    if isinstance(value, date | time):
        return value.isoformat()
    if isinstance(value, int):  # truth values are numbers, too
        return json.dumps(value)
    raise TypeError(f"TOML has no value like {value!r}")
