"""What a session tells whoever runs it. Drained by `Session.events`, in order.

Every event survives pickling, so that another process may receive it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from drivers.errors import RefusalError
from drivers.packets import InitPacket
from drivers.states import State

Outcome = Literal["completed", "stopped", "refused", "lost"]


@dataclass
class Counters:
    """How many packets had which fate since the session was made.

    `missed` never arrived; `discarded` were dropped by the link, by kind ("foreign", "torn", ...);
    `unanswered` are answers of ours that the controller did not take, see `AnswersLost`.
    """

    answered: int = 0
    duplicates: int = 0
    malformed: int = 0
    stale: int = 0
    ended: int = 0
    missed: int = 0
    refused: int = 0
    unanswered: int = 0
    discarded: dict[str, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class InitReceived:
    """The controller started a session.

    Attributes:
        init: its init packet.
        unusable: why this session cannot move the arm, or None if it can.
        differences: from what the cell says of the arm, each naming the axis and both values.
        adopted: the controller's gear ratios, calibration and coupling are in force.
    """

    init: InitPacket = field(repr=False)
    unusable: str | None
    differences: tuple[str, ...] = ()
    adopted: bool = False


@dataclass(frozen=True)
class StateChanged:
    """The session went from one state to another in `cycle`."""

    before: State
    after: State
    cycle: int


@dataclass(frozen=True)
class GapSeen:
    """`missed` packets before the one of `cycle` never arrived."""

    missed: int
    cycle: int


@dataclass(frozen=True)
class AnswersLost:
    """The target received in `cycle` is older than the last set-point; `count` were not accepted.

    Seen only in modes 1, 4 and 5, where a joint moves by more than what counts as standstill in
    each cycle, and where the controller then holds its target rather than carry it on.
    """

    count: int
    cycle: int


@dataclass(frozen=True)
class MotionStarted:
    """The first set-point left in `cycle`; records carry `interval`."""

    interval: int
    cycle: int


@dataclass(frozen=True)
class OverrideChanged:
    """From `cycle` on the requested motion was to go on at this fraction of its planned speed."""

    fraction: float
    cycle: int


@dataclass(frozen=True)
class HoldChanged:
    """In `cycle` the requested motion was asked to rest on its path, or (not `held`) to go on."""

    held: bool
    cycle: int


@dataclass(frozen=True)
class MotionEnded:
    """The end of a requested motion.

    Attributes:
        outcome: "completed" and "stopped": open mode was left after coming to rest; "refused":
            a set-point was refused; "lost": drive, open mode or link went away.
        reason: in words.
        interval: of its records, -1 if it never saw open mode.
        cycle: when.
    """

    outcome: Outcome
    reason: str
    interval: int
    cycle: int


@dataclass(frozen=True)
class PacketRejected:
    """`count` packets since the last drain got no answer.

    Attributes:
        kind: "malformed", "stale" or "ended", or what the link discarded them for.
        count: how many.
        reason: of the last one; "" if unknown.
    """

    kind: str
    count: int
    reason: str = field(default="", compare=False)


@dataclass(frozen=True, eq=False)
class Refused:
    """A set-point did not leave.

    Attributes:
        error: why.
        flight_recorder: (k,) of `cycle_dtype`, the last records up to and including this cycle.
    """

    error: RefusalError
    flight_recorder: NDArray[np.void] = field(repr=False)


@dataclass(frozen=True)
class LinkLost:
    """Nothing was heard for `silence` s; `state` is the state in which that happened.

    Or nothing new: `stale` packets came meanwhile that cannot follow the last one.
    """

    silence: float
    state: State
    stale: int = 0


Event = (
    InitReceived
    | StateChanged
    | GapSeen
    | AnswersLost
    | MotionStarted
    | OverrideChanged
    | HoldChanged
    | MotionEnded
    | PacketRejected
    | Refused
    | LinkLost
)
