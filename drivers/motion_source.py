"""What the session asks for the next set-point."""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
BoundsName = Literal["plan", "override", "stop"]


class MotionSource(Protocol):
    """One motion, told cycle by cycle. Joint arrays are (n,), rad and rad/s.

    The session calls `begin` once, in the cycle that carries the first set-point (the position
    given, at zero velocity), then `advance` once for each later packet that it answers. Nothing
    here knows a clock: after a gap the motion goes on where it was.
    """

    @property
    def start(self) -> Array:
        """Where the motion wants to begin."""
        ...

    @property
    def finished(self) -> bool:
        """Whether the last set-point given was the end of the motion (or of a stop), at rest."""
        ...

    @property
    def bounds(self) -> BoundsName:
        """Which set of bounds the set-points keep from now on: "stop" only after `stop`.

        The session grants "override" to nobody as long as none can be asked for.
        """
        ...

    def begin(self, position: Array) -> None:
        """Take `position` as the first set-point; raise if the motion cannot begin there."""
        ...

    def advance(self) -> tuple[Array, Array]:
        """The next set-point, one period on: position and velocity."""
        ...

    def stop(self) -> None:
        """Come to rest on the path; `finished` tells when. Calling it again changes nothing.

        The session asks for drive-off if that takes longer than `session.STOP_TIMEOUT`.
        """
        ...
