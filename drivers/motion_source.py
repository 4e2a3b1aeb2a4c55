"""What the session asks for the next set-point, or the next correction.

===========  ==========================================================  ====================
open mode    who generates the targets                                   source
===========  ==========================================================  ====================
4, 5         the PC                                                      `MotionSource`
1            the PC, with feed-forward of velocity and current           `MotionSource`, or
                                                                         `FeedForwardSource`
2, 7, 8, 9   the controller; the PC corrects them                        `CorrectionSource`
===========  ==========================================================  ====================
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final, Literal, Protocol, TypeGuard

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BoundsName = Literal["plan", "override", "stop"]


class MotionSource(Protocol):
    """One motion, given cycle by cycle. Joint arrays are (n,), rad and rad/s.

    The session calls `begin` once, in the cycle that carries the first set-point (the position
    given, at zero velocity), then `advance` once for each later packet that it answers. Nothing
    here knows a clock: after a gap the motion goes on where it was.
    """

    @property
    def start(self) -> Array:
        """Where the motion wants to begin."""

    @property
    def finished(self) -> bool:
        """Whether the last set-point given was the end of the motion (or of a stop), at rest."""

    @property
    def bounds(self) -> BoundsName:
        """Which set of bounds the set-points keep from now on.

        "override" is granted from the first change of override on (`OverridableSource`), "stop"
        from `stop`, or the first `hold` (`HoldableSource`), on.
        """

    def begin(self, position: Array) -> None:
        """Take `position` as the first set-point; raise if the motion cannot begin there."""

    def advance(self) -> tuple[Array, Array]:
        """The next set-point, one period on: position and velocity."""

    def stop(self) -> None:
        """Come to rest on the path; `finished` tells when. Calling it again changes nothing.

        The session asks for drive-off if that takes longer than `session.STOP_TIMEOUT`.
        """


class FeedForwardSource(MotionSource, Protocol):
    """A motion that knows what it takes to follow it, for open mode 1."""

    def feed_forward(self) -> tuple[Array, Array]:
        """Velocity (n,) rad/s and motor current (n,) A that go with the set-point given last.

        Asked for once after each `advance`. Both start at zero with the first set-point and have
        to be back at zero when the motion says that it is finished. Without this method the
        velocity fed forward is that of the set-points, and the current zero.
        """


class CorrectionSource(Protocol):
    """Corrections of a motion that the controller itself generates. Joint arrays are (n,).

    Like a `MotionSource`, it is asked once per answered packet. A correction starts at zero,
    keeps the bounds of a plan (those of a stop after `stop`, and from `hold` until it rests: a
    velocity at zero, an offset unchanged), and has to be back at zero when it
    says that it is finished; the session never clamps or fades it.
    """

    @property
    def finished(self) -> bool:
        """Whether the corrections given last were the end, zero."""

    def begin(self) -> None:
        """The first packet with every axis open is answered by zeros; raise to refuse."""

    def advance(self) -> tuple[Array, Array]:
        """The next correction: motion and motor current, A.

        ====  ===========================================  ======================================
        mode  motion                                       current
        ====  ===========================================  ======================================
        2     velocity fed forward, rad/s                  fed forward
        7     offset from the controller's target, rad     none: zeros
        8     velocity fed forward, rad/s                  none: zeros
        9     none: zeros                                  added to the servo's own
        ====  ===========================================  ======================================
        """

    def stop(self) -> None:
        """Take the correction back to zero; `finished` tells when."""


class OverridableSource(Protocol):
    """A source whose speed can be changed while it runs."""

    def override(self, fraction: float) -> None:
        """Go on at this fraction (0..1) of the planned speed, within the bounds "override"."""


class HoldableSource(Protocol):
    """A source that can rest on its path and go on from there."""

    def hold(self) -> None:
        """Come to rest on the path, within the bounds of a stop, and wait; not `finished`.

        A hold may last for ever; `stop` may follow it. A source that goes on instead is stopped
        after `session.STOP_TIMEOUT`.
        """

    def resume(self) -> None:
        """Go on, within the bounds of a stop until the speed is what it was."""


class ResumableSource(Protocol):
    """A source that can go on from where a controller carried its motion by itself."""

    def resume_from(self, position: Array, velocity: Array, cycles: int) -> None:
        """The controller's target is here, (n,) rad and rad/s: go on along the path, as asked for.

        A velocity across the path dies away in so many cycles. Raises if it is not on the path.
        """


_OF_MOTIONS: Final = ("begin", "advance", "finished", "bounds", "stop")
_OF_CORRECTIONS: Final = ("begin", "advance", "finished", "stop")


def is_motion(source: object) -> TypeGuard[MotionSource]:
    """Whether it has what a `MotionSource` is asked for; nothing of it is called."""
    return _has(source, _OF_MOTIONS)


def is_correction(source: object) -> TypeGuard[CorrectionSource]:
    """Whether it has what a `CorrectionSource` is asked for and no bounds, as motions have."""
    return _has(source, _OF_CORRECTIONS) and not _has(source, ("bounds",))


def is_holdable(source: object) -> TypeGuard[HoldableSource]:
    """Whether it has what a `HoldableSource` is asked for."""
    return _has(source, ("hold", "resume"))


def progress_of(source: object) -> tuple[float, float]:
    """Motion time, s, and how fast it runs (1 as planned); NaN where a source does not tell.

    Nothing in the cycle depends on them, so whatever a source raises counts as not telling.
    """
    return _number_of(source, "motion_time"), _number_of(source, "rate")


def _number_of(source: object, name: str) -> float:
    try:
        return float(getattr(source, name))
    except BaseException:
        return math.nan


def _has(source: object, names: Sequence[str]) -> bool:
    # A property is found on the class, without running the source's code.
    return all(
        hasattr(type(source), name) or name in getattr(source, "__dict__", ()) for name in names
    )
