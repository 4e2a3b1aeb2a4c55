"""Events of a session, drained by `Session.events` in order. All of them can be pickled."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.arrays import Array
from drivers.errors import RefusalError
from drivers.states import Outcome, State


class ControllerDescription(Protocol):
    """What a controller states of itself before the cyclic exchange.

    Attributes:
        attachment: name of the file of an archive that has it.
    """

    attachment: ClassVar[str]

    @property
    def period(self) -> float:
        """Cycle, s."""

    def encode(self) -> bytes:
        """Return the content of that file."""

    def stated(
        self, limit: Literal["current_limit", "following_error"], arm: int, n_joints: int
    ) -> Array:
        """Return its limit of an arm, from 1, by joint [A, motor revolutions]; NaN for none."""


@dataclass
class Counters:
    """Packets since the session was created.

    `missed` never arrived; `discarded` were dropped by the link, by kind ("foreign", "torn", ...);
    `rejected` are replies that the controller did not accept, see `RepliesLost`.
    """

    replied: int = 0
    duplicates: int = 0
    malformed: int = 0
    stale: int = 0
    ended: int = 0
    missed: int = 0
    refused: int = 0
    rejected: int = 0
    discarded: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class InitReceived:
    """The controller started a session.

    `unusable` is why the arm cannot be moved, or None; `differences` from the cell name axis and
    both values.
    """

    init: ControllerDescription = field(repr=False)
    unusable: str | None
    differences: tuple[str, ...] = ()


@dataclass(frozen=True)
class StateChanged:
    """The session changed its state in `cycle`."""

    before: State
    after: State
    cycle: int


@dataclass(frozen=True)
class GapSeen:
    """`missed` packets before the packet of `cycle` did not arrive."""

    missed: int
    cycle: int


@dataclass(frozen=True)
class RepliesLost:
    """The target received in `cycle` belongs to an earlier set-point; `count` were not accepted.

    Detected only while a joint moves by more than the standstill threshold per
    cycle and the controller holds its target.
    """

    count: int
    cycle: int


@dataclass(frozen=True)
class MotionStarted:
    """The first set-point was sent in `cycle`; its records have this `interval`."""

    interval: int
    cycle: int


@dataclass(frozen=True)
class OverrideChanged:
    """From `cycle` on the requested motion runs at this fraction of its planned speed."""

    fraction: float
    cycle: int


@dataclass(frozen=True)
class HoldChanged:
    """In `cycle` a hold of the requested motion was requested, or (not `held`) its end."""

    held: bool
    cycle: int


@dataclass(frozen=True)
class MotionEnded:
    """The end of a requested motion in `cycle`; `interval` of its records is -1 without open mode.

    "completed" and "stopped": open mode was left after coming to rest; "refused": a set-point was
    refused; "lost": drive, open mode or link was lost.
    """

    outcome: Outcome
    reason: str
    interval: int
    cycle: int


@dataclass(frozen=True)
class PacketRejected:
    """`count` packets since the last drain got no reply.

    `kind` is "malformed", "stale" or "ended", or the link's reason to discard them; `reason` is
    that of the last one, "" if unknown.
    """

    kind: str
    count: int
    reason: str = field(default="", compare=False)


@dataclass(frozen=True)
class ControllerRemark:
    """What a controller says in words, in `cycle`."""

    text: str
    cycle: int


@dataclass(frozen=True, eq=False)
class Refused:
    """A set-point was not sent, because of `error`.

    `flight_recorder` (k,) of `cycle_dtype` has the last records up to and including this cycle.
    """

    error: RefusalError
    flight_recorder: NDArray[np.void] = field(repr=False)

    @property
    def cycle(self) -> int:
        """The controller's cycle in which it was due."""
        return self.error.cycle


@dataclass(frozen=True)
class LinkLost:
    """No valid packet arrived for `silence` s in this state.

    `stale` packets arrived meanwhile whose numbers cannot follow the last one.
    """

    silence: float
    state: State
    stale: int = 0


Event = (
    InitReceived
    | StateChanged
    | GapSeen
    | RepliesLost
    | MotionStarted
    | OverrideChanged
    | HoldChanged
    | MotionEnded
    | PacketRejected
    | ControllerRemark
    | Refused
    | LinkLost
)
