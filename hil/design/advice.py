"""What a person can change when a search found no motion that keeps every constraint."""

from __future__ import annotations

from typing import Final

from hil.errors import UnsafeError
from identification.excitation import NoFeasibleMotionError

_ADVICE: Final = {
    "collision": (
        "let via points lie nearer the middle of their ranges ([via_points] range_share), take "
        "fewer of them, search longer, or check floor, walls, margin and home of the cell"
    ),
    "current": (
        "allow slower motions ([via_points] slowest, [constraints] max_duration), or check "
        "current limits and uncertainty of the cell"
    ),
    "torque": "allow slower motions ([via_points] slowest, [constraints] max_duration)",
    "duration": (
        "allow more time ([constraints] max_duration), take fewer via points, or raise "
        "[via_points] slowest"
    ),
    "joint limit": "take longer ramps or lower frequencies ([sines] ramp, fastest)",
    "planning": "ask for another fly, or for fewer via points",
}


class NoExcitationError(UnsafeError):
    """Every motion that a design tried would have to be refused."""


def no_excitation(error: NoFeasibleMotionError) -> NoExcitationError:
    """Return the error for a person: what forbids every motion, and what could be changed."""
    worst = sorted(error.rejected, key=lambda kind: -error.rejected[kind])
    advice = next((_ADVICE[kind] for kind in worst if kind in _ADVICE), "")
    return NoExcitationError(f"{error}. What can be changed: {advice}" if advice else str(error))
