"""A motion while it goes on: what is seen of it, and what the person at the machine requests."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.states import State

Array = NDArray[np.float64]


@dataclass(frozen=True)
class OperatorRequest:
    """What the person wants of the motion, until another request.

    Attributes:
        override: fraction (0 to 1) of the planned speed.
        held: whether the arm is to rest on its path.

    Raises:
        ValueError: an override that is none.
    """

    override: float = 1.0
    held: bool = False

    def __post_init__(self) -> None:
        if not 0.0 <= self.override <= 1.0:
            raise ValueError(f"an override of {self.override!r} is not one of 0..1")


@dataclass(frozen=True)
class Latency:
    """How long the PC took, from a packet's arrival to the departure of its answer, this motion.

    Attributes:
        median: s.
        p99: s, not exceeded by 99 % of the answers.
        worst: s.
    """

    median: float
    p99: float
    worst: float


@dataclass(frozen=True, eq=False)
class MotionProgress:
    """A motion at one moment. Joint arrays are (n,); None before the first record.

    Attributes:
        motion_time: s of the planned motion done; None if the source does not tell.
        duration: s of the planned motion, at full speed; None if the source does not tell.
        cycles: answered since this motion was asked for.
        missed: packets that never arrived, of them.
        late: answers late, or left out for a newer packet's.
        untaken: answers that the controller did not take.
        state: of the session.
        position: rad, measured.
        following_error: rad, the controller's target minus position.
        following_share: magnitude of that as a share of the threshold in force.
        current: A at the motors, the controller's target (there is no measured one).
        current_share: magnitude of that as a share of the limit in force.
        temperature: °C at the motors; None where the controller tells none (C4G Open does not).
        override: the fraction asked for last.
        rate: fraction of the planned speed at this moment; None if the source does not tell.
        held: whether a hold was asked for.
        latency: None in virtual time, which has none, and before the first answer.
        events: the last ones of this motion, in words, oldest first.
    """

    motion_time: float | None
    duration: float | None
    cycles: int
    missed: int
    late: int
    untaken: int
    state: State
    position: Array | None = None
    following_error: Array | None = None
    following_share: Array | None = None
    current: Array | None = None
    current_share: Array | None = None
    temperature: Array | None = None
    override: float = 1.0
    rate: float | None = None
    held: bool = False
    latency: Latency | None = None
    events: tuple[str, ...] = ()


class MotionWatch(Protocol):
    """Whoever looks at a motion and may slow, hold and release it.

    Both are called from the loop that supervises the motion and must return at once: no stop and
    no hold is passed on meanwhile. On a real link the arm is brought to rest on its path when one
    of them takes longer than a second.
    """

    def show(self, progress: MotionProgress) -> None:
        """Look; called about ten times a second."""
        ...

    def request(self) -> OperatorRequest:
        """The latest request."""
        ...


class Unwatched:
    """Nobody looks, and nobody requests anything else than the motion as it was planned."""

    def show(self, progress: MotionProgress) -> None:
        """Nobody looks."""

    def request(self) -> OperatorRequest:
        """The motion as it was planned."""
        return OperatorRequest()


unwatched_motion = Unwatched()
"""For motions that nobody watches."""
