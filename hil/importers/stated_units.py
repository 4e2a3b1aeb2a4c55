"""Units that a log states: in brackets or at the end of a name, or in a line below the names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

from hil.base.errors import SourceError
from hil.importers.name_words import is_qualifier
from hil.importers.units import SUFFIXES, Kind, names_of_units, unit_of

_BRACKETED: Final = re.compile(r"(.*?)[\s_]*(?:\[([^\[\]]*)\]|\(([^()]*)\))")
_LIKE_A_UNIT: Final = re.compile(r"[A-Za-zµμΩ°%‰·⋅*./^⁻¹²³ '\"-]{1,16}")
_NO_UNIT: Final = frozenset({"", "-", "--", "none", "n/a", "na", "null", "bool", "text", "string"})


def stated_unit(text: str) -> str | None:
    """Return the unit that the text of a unit is, also one that is not known; None if it is none.

    One that is not known is returned as it is written.
    """
    text = text.strip("[]() \t")
    known = unit_of(text)
    if known is not None or text.lower() in _NO_UNIT:
        return known
    is_like = _LIKE_A_UNIT.fullmatch(text) is not None and any(map(str.isalpha, text))
    return text if is_like and not is_qualifier(text) else None


def without_unit(name: str) -> tuple[str, str | None]:
    """Return the name of a column without its unit, and that unit or None.

    A unit is in brackets, as in ``q1 [deg]`` or ``M1 (Nm)``, or a few are at the end, ``q1_deg``.
    It may be none that is known, see `stated_unit`.
    """
    match = _BRACKETED.fullmatch(name.strip())
    if match is not None:
        unit = stated_unit(match[2] if match[2] is not None else match[3])
        if unit is not None:
            return match[1], unit
    bare, _, end = name.rpartition("_")
    if bare and end in SUFFIXES:
        return bare, unit_of(end) or end
    return name, None


def other_unit(path: Path, kind: Kind, channels: str, unit: str) -> SourceError:
    """Return the refusal of channels whose unit belongs to another quantity, or to none.

    Args:
        path: of the log.
        kind: quantity.
        channels: its names.
        unit: that is stated.
    """
    is_known = unit_of(unit) is not None
    which = f"which is not a unit of {kind}" if is_known else "a unit that is not known"
    si = names_of_units(kind).partition(",")[0]
    remedy = (
        f'state how it is read, in a map (--map): [{kind}] unit = "{si}", scale = FACTOR, by which '
        f"its numbers become {si}; known are {names_of_units(kind)}, and products such as kgf cm"
    )
    problem = f"{channels} is stated in {unit}, {which}"
    return SourceError(path, problem, field=f"{kind}.unit", remedy=remedy)
