"""Numbers as servos and drives encode them: signs in a bit, parts of a rated torque, ticks."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.importers.name_words import words_of

_SIGN_BITS: Final = (10, 15)
"""Of loads and of speeds, of servos of Dynamixel and Feetech."""
_MAX_STEP_SHARE: Final = 0.5  # of the largest magnitude, between samples of one joint
_TORQUE_OBJECT: Final = re.compile(r"6077|6078", re.IGNORECASE)
_ACTUAL: Final = (
    frozenset({"torque", "actual", "value"}),
    frozenset({"current", "actual", "value"}),
)
"""Words of the names that the standard gives these objects."""
_MAX_PER_MILLE: Final = 10_000.0  # per mille


class Encoder(NamedTuple):
    """Ticks of an encoder: in a turn, and at the zero of the angle."""

    ticks: int
    middle: int
    turn: float  #: angle of all ticks [rad]


_ENCODERS: Final = (
    Encoder(1024, 512, np.radians(300.0)),
    Encoder(4096, 2048, 2.0 * np.pi),
    Encoder(16384, 8192, 2.0 * np.pi),
    Encoder(65536, 32768, 2.0 * np.pi),
)


def are_whole(values: Array) -> bool:
    """Return whether all known values (m, n) are whole numbers, and some are not 0."""
    known = values[np.isfinite(values)]
    return bool(known.size and np.any(known) and np.array_equal(known, np.rint(known)))


def signed(values: Array, bit: int) -> Array:
    """Return magnitudes (m, n) with the sign in a bit as signed numbers."""
    limit = float(1 << bit)
    return np.where(values >= limit, limit - values, values)


def sign_bit_of(values: Array) -> int | None:
    """Return the bit with the sign of magnitudes (m, n); None if they are signed numbers.

    They are whole and never negative, and jump where the sign changes: without the bit they do not.
    """
    if not are_whole(values) or np.nanmin(values) < 0.0:
        return None
    for bit in _SIGN_BITS:
        limit = float(1 << bit)
        if not limit <= np.nanmax(values) < 2.0 * limit:
            continue
        read = signed(values, bit)
        steps = np.abs(np.diff(read, axis=0))
        both = np.any(values >= limit, axis=0) & np.any((values > 0.0) & (values < limit), axis=0)
        longest = _MAX_STEP_SHARE * np.nanmax(np.abs(read))
        if both.any() and np.nanmax(steps) < longest:
            return bit
    return None


def are_per_mille(names: Sequence[str], values: Array) -> bool:
    """Return whether values (m, n) may be the objects 6077h or 6078h of a drive.

    These are whole, in per mille of its rated torque or current.
    """
    named = all(
        _TORQUE_OBJECT.search(name) or any(words <= {*words_of(name)} for words in _ACTUAL)
        for name in names
    )
    return (
        bool(names) and named and are_whole(values) and np.nanmax(np.abs(values)) < _MAX_PER_MILLE
    )


def encoder_of(values: Array) -> Encoder | None:
    """Return the encoder whose ticks positions (m, n) are, about its middle; None if they are none.

    The smallest that has all of them.
    """
    if not are_whole(values) or np.nanmin(values) < 0.0:
        return None
    highest = np.nanmax(values)
    return next((each for each in _ENCODERS if each.middle < highest < each.ticks), None)
