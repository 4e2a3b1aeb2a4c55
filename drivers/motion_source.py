"""Sources of set-points for a session: the PC generates the targets, in open modes 4 and 5."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, Protocol

from drivers.arrays import Array

BoundsName = Literal["plan", "override", "stop"]


class MotionSource(Protocol):
    """One motion, given cycle by cycle. Joint arrays are (n,), rad and rad/s.

    The session calls `begin` once, in the cycle of the first set-point (the position given, at zero
    velocity), then `advance` once for each later packet that it replies to. A source has no clock:
    after a gap the motion continues where it was.

    Further methods are optional; without them the session refuses or does what they are for
    differently:

    - ``override(fraction)``: continue at this fraction (0..1) of the planned speed, within the
      bounds "override".
    - ``hold()`` and ``resume()``: come to rest on the path, within the bounds of a stop, and wait,
      not `finished`; continue, within the same bounds until the former speed is reached. `stop` may
      follow a hold. One that does not come to rest is stopped after `session.STOP_TIMEOUT`.
    - ``resume_from(position, velocity, cycles)``: continue along the path from the target, (n,) rad
      and rad/s, to which a controller has extrapolated the motion. A velocity across the path
      decays within `cycles`. During a stop also from the set-point sent last, at a lower velocity.
      Raises if the target is off the path.

    Attributes ``motion_time`` (s) and ``rate`` (1 as planned), if both exist, are displayed.
    """

    @property
    def start(self) -> Array:
        """Planned start of the motion."""

    @property
    def finished(self) -> bool:
        """Whether the last set-point given was the end of the motion (or of a stop), at rest."""

    @property
    def bounds(self) -> BoundsName:
        """Set of bounds that the set-points satisfy from now on.

        "override" is allowed from the first change of override on, "stop" from `stop`, or the first
        `hold`, on.
        """

    def begin(self, position: Array) -> None:
        """Begin at `position`, the first set-point; raise if that is not possible."""

    def advance(self) -> tuple[Array, Array]:
        """Return position and velocity of the next set-point, one period on."""

    def stop(self) -> None:
        """Come to rest on the path; then `finished` is true. Calling it again changes nothing.

        Drive-off is requested if that takes longer than `session.STOP_TIMEOUT`.
        """


def has_members(source: object, names: Sequence[str]) -> bool:
    """Whether a source has these members; none of them is called."""
    # A property is found on the class, without running the source's code.
    return all(
        hasattr(type(source), name) or name in getattr(source, "__dict__", ()) for name in names
    )


def progress_of(source: object) -> tuple[float, float]:
    """Return motion time, s, and rate (1 as planned); NaN where a source does not give them.

    A source that raises counts as not giving them: the cycle does not depend on either.
    """
    try:
        return float(source.motion_time), float(source.rate)  # type: ignore[attr-defined]
    except BaseException:
        return math.nan, math.nan
