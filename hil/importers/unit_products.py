"""Units that are products and quotients of others: ``kgf cm``, ``ozf-in``, ``lbf.ft``, ``gon/s``.

Factors by NIST SP 811, appendix B.
"""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from functools import lru_cache
from typing import Final, NamedTuple

_POUND_FORCE: Final = 4.4482216152605  # N
_KILOGRAM_FORCE: Final = 9.80665  # N, its weight
_FORCES: Final = {
    "n": 1.0, "kn": 1e3, "mn": 1e-3, "dyn": 1e-5, "kgf": _KILOGRAM_FORCE, "kp": _KILOGRAM_FORCE,
    "gf": 1e-3 * _KILOGRAM_FORCE, "lbf": _POUND_FORCE, "ozf": _POUND_FORCE / 16.0,
}  # fmt: skip
_WEIGHTS: Final = {
    "kg": _KILOGRAM_FORCE, "g": 1e-3 * _KILOGRAM_FORCE, "lb": _POUND_FORCE, "lbs": _POUND_FORCE,
    "oz": _POUND_FORCE / 16.0,
}  # fmt: skip
"""Masses that mean their weights if a length follows, as in the torque of servos."""
_LENGTHS: Final = {
    "m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 0.0254, "inch": 0.0254, "ft": 0.3048, "foot": 0.3048,
}  # fmt: skip
DEGREE: Final = math.pi / 180.0
_ANGLES: Final = {
    "rad": 1.0, "mrad": 1e-3, "deg": DEGREE, "degree": DEGREE, "degrees": DEGREE, "°": DEGREE,
    "mdeg": 1e-3 * DEGREE, "gon": math.pi / 200.0, "arcmin": DEGREE / 60.0,
    "arcsec": DEGREE / 3600.0, "rev": 2.0 * math.pi, "turn": 2.0 * math.pi,
    "turns": 2.0 * math.pi,
}  # fmt: skip
_TIMES: Final = {
    "s": 1.0, "sec": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "minute": 60.0, "h": 3600.0,
}  # fmt: skip
_CURRENTS: Final = {"a": 1.0, "ma": 1e-3, "ka": 1e3, "ua": 1e-6}
_ATOMS: Final[Mapping[str, tuple[str, float]]] = {
    name: (dimension, factor)
    for dimension, table in (
        ("force", {**_FORCES, **_WEIGHTS}), ("length", _LENGTHS), ("angle", _ANGLES),
        ("time", _TIMES), ("current", _CURRENTS),
    )
    for name, factor in table.items()
}  # fmt: skip
_DIMENSIONS: Final[Mapping[frozenset[tuple[str, int]], tuple[str, ...]]] = {
    frozenset({("angle", 1)}): ("position", "commanded_position"),
    frozenset({("length", 1)}): ("position", "commanded_position"),
    frozenset({("angle", 1), ("time", -1)}): ("velocity",),
    frozenset({("length", 1), ("time", -1)}): ("velocity",),
    frozenset({("force", 1), ("length", 1)}): ("torque",),
    frozenset({("force", 1)}): ("torque",),
    frozenset({("current", 1)}): ("motor_current",),
    frozenset({("time", 1)}): ("time",),
}
_SUPERSCRIPTS: Final = str.maketrans("⁻¹²³−⋅∙", "-123-··")
_SLASH: Final = re.compile(r"/|\bper\b")
_BETWEEN: Final = re.compile(r"[\s·*.×_]+|(?<=[^\d^])-(?=\D)")
_POWER: Final = re.compile(r"(?P<name>[^\d^-]+)(?:\^?(?P<power>-?\d))?")
_MAX_UNIT_CHARACTERS: Final = 24  # characters


class UnitProduct(NamedTuple):
    """A unit: its quantities, and its factor to SI units."""

    kinds: tuple[str, ...]
    factor: float


@lru_cache(maxsize=512)
def product_of(text: str) -> UnitProduct | None:
    """Return the quantity of a product or quotient of units; None for other text.

    Kilograms, grams, pounds and ounces are their weights, and only with a length.
    """
    text = text.strip().lower().translate(_SUPERSCRIPTS)
    if not text or len(text) > _MAX_UNIT_CHARACTERS:
        return None
    powers: Counter[str] = Counter()
    names = []
    factor = 1.0
    for index, part in enumerate(_SLASH.split(text)):
        for name, power in _powers(part):
            if name not in _ATOMS:
                return None
            dimension, size = _ATOMS[name]
            signed = -power if index else power
            names.append(name)
            powers[dimension] += signed
            factor *= size**signed
    found = frozenset((name, power) for name, power in powers.items() if power)
    if found == {("force", 1)} and names[0] in _WEIGHTS:
        return None
    kinds = _DIMENSIONS.get(found, ())
    return UnitProduct(kinds, factor) if kinds else None


def _powers(part: str) -> list[tuple[str, int]]:
    """Return the units of a product, each with its power; an empty name where one is none."""
    powers = []
    for word in _BETWEEN.split(part.strip(" ()")):
        match = _POWER.fullmatch(word)
        if match is None:
            return [("", 1)]
        power = int(match["power"] or 1)
        powers += [(name, power) for name in _separate(match["name"])]
    return powers


def _separate(word: str) -> list[str]:
    """Return the units of a word: itself, or a force and a length that follow each other."""
    if word in _ATOMS:
        return [word]
    pairs = [(word[:k], word[k:]) for k in range(1, len(word))]
    for first, second in pairs:
        kinds = {_ATOMS.get(first, ("",))[0], _ATOMS.get(second, ("",))[0]}
        if kinds == {"force", "length"}:
            return [first, second]
    return [word]
