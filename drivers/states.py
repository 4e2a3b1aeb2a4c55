"""State table of a session, and its decisions.

A cyclic packet is first classified as one `Input` by `read_input`; the table gives the state that
follows. Init packets, silence, refusals and exits are inputs as well, so that every change of
state is an entry of the table. `decide` says what becomes of state and requested motion; it changes
nothing, the session applies it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.c4g_packets import MODE_FIELDS, Mode
from drivers.packet_losses import LossTracker

Outcome = Literal["completed", "stopped", "refused", "lost"]
"""How a requested motion ended."""


class State(IntEnum):
    """State of a session."""

    SYNC = 0
    INIT = 1
    DRIVE_OFF = 2
    DRIVING_ON = 3
    CLOSED = 4
    OPENING = 5
    OPEN = 6
    EXITING = 7
    FREEZING = 8
    FAULTED = 9
    ENDED = 10


class Input(IntEnum):
    """Cause of a change of state."""

    SYNC = 0
    """A packet before the init packet, or one of the two after it."""
    INIT = 1
    """An init packet."""
    OFF = 2
    """The arm's drive is not on, in any mode."""
    DRIVING_ON = 3
    """Mode 501 in a wanted axis."""
    CLOSED = 4
    """Every wanted axis in mode 0 or 10."""
    PARTLY_OPEN = 5
    """A wanted axis in an open mode, but not all of them in the wanted mode."""
    OPEN = 6
    """Every wanted axis in the wanted mode."""
    PAUSE = 7
    """Mode 500 or 502 in a wanted axis: the controller pauses the exchange."""
    UNAVAILABLE = 8
    """A wanted axis in a mode to which the reply is unknown."""
    END = 9
    """Mode 504 in every axis."""
    REFUSAL = 10
    """The session refused a set-point."""
    EXIT = 11
    """The session requested the end of open mode."""
    SILENCE = 12
    """No packet before the deadline."""


OPEN_MODES: Final = frozenset(MODE_FIELDS)
HOLDABLE_MODES: Final = frozenset(mode for mode, d in MODE_FIELDS.items() if d[:2] == (1, 2))
"""Open modes in which D1 is an absolute position: the target received is the safe reply."""
INCREMENTAL_MODES: Final = OPEN_MODES - HOLDABLE_MODES
"""Open modes in which zero is the safe reply."""
POSITION_MODES: Final = frozenset({Mode.POSITION, Mode.POSITION_RELATIVE})
"""Open modes in which the PC generates the targets, so that a motion can run."""
CLOSED_MODES: Final = frozenset({Mode.CLOSED, Mode.CLOSED_MIRRORED})
PAUSE_MODES: Final = frozenset({Mode.PAUSE_BY_PC, Mode.PAUSE_BY_CONTROLLER})
KNOWN_MODES: Final = OPEN_MODES | CLOSED_MODES | PAUSE_MODES | {Mode.DRIVING_ON}
"""Modes to which the reply is known."""


def read_input(
    drive_on: bool, all_modes: Sequence[int], wanted_modes: Sequence[int], mode: int
) -> Input:
    """Classify a cyclic packet.

    Args:
        drive_on: whether the arm's drive is on.
        all_modes: mode of every slot.
        wanted_modes: modes of the wanted axes.
        mode: open mode in which these are to be moved.
    """
    if all(m == Mode.END_OF_SESSION for m in all_modes):
        return Input.END
    if not drive_on:
        return Input.OFF
    if not wanted_modes:
        return Input.CLOSED
    if any(m not in KNOWN_MODES for m in wanted_modes):
        return Input.UNAVAILABLE
    if any(m in PAUSE_MODES for m in wanted_modes):
        return Input.PAUSE
    if all(m == mode for m in wanted_modes):
        return Input.OPEN
    if any(m in OPEN_MODES for m in wanted_modes):
        return Input.PARTLY_OPEN
    if all(m in CLOSED_MODES for m in wanted_modes):
        return Input.CLOSED
    return Input.DRIVING_ON


_ANY: Final[Mapping[Input, State]] = {
    Input.INIT: State.INIT,
    Input.OFF: State.DRIVE_OFF,
    Input.DRIVING_ON: State.DRIVING_ON,
    Input.CLOSED: State.CLOSED,
    Input.PAUSE: State.FREEZING,
    Input.UNAVAILABLE: State.FAULTED,
    Input.END: State.ENDED,
    Input.REFUSAL: State.FAULTED,
    Input.SILENCE: State.FAULTED,
}
_MAY_OPEN: Final = {Input.PARTLY_OPEN: State.OPENING, Input.OPEN: State.OPEN}
_MUST_CLOSE_FIRST: Final = dict.fromkeys((Input.PARTLY_OPEN, Input.OPEN), State.FAULTED)

TRANSITIONS: Final[Mapping[State, Mapping[Input, State]]] = {
    State.SYNC: {
        Input.SYNC: State.SYNC,
        Input.INIT: State.INIT,
        Input.SILENCE: State.SYNC,
    },
    State.INIT: {**_ANY, **_MUST_CLOSE_FIRST, Input.SYNC: State.INIT},
    State.DRIVE_OFF: {**_ANY, **_MUST_CLOSE_FIRST},
    State.DRIVING_ON: {**_ANY, **_MAY_OPEN},
    State.CLOSED: {**_ANY, **_MAY_OPEN},
    State.OPENING: {**_ANY, **_MAY_OPEN, Input.EXIT: State.EXITING},
    State.OPEN: {
        **_ANY,
        Input.OPEN: State.OPEN,
        Input.PARTLY_OPEN: State.EXITING,
        Input.EXIT: State.EXITING,
    },
    State.EXITING: {
        **_ANY,
        **dict.fromkeys((Input.PARTLY_OPEN, Input.OPEN, Input.EXIT), State.EXITING),
    },
    # The modes after a pause are not documented, so axes have to close first.
    State.FREEZING: {**_ANY, **_MUST_CLOSE_FIRST},
    # A cold start of the controller begins with sync packets, after a silence.
    State.FAULTED: {**_ANY, **_MUST_CLOSE_FIRST, Input.SYNC: State.SYNC},
    State.ENDED: {},
}
"""`TRANSITIONS[state][input]` is the next state; missing entries cannot occur."""

STATES_WITH_SET_POINTS: Final = frozenset({State.OPENING, State.OPEN, State.EXITING})
"""States in which open axes are sent set-points."""

_STATES_BEFORE_DRIVE_ON: Final = frozenset({State.INIT, State.DRIVE_OFF})


def keeps_request(before: State, after: State) -> bool:
    """Return whether a requested motion that has not begun stays requested over this transition.

    It waits for the start of the controller, for the drive and for open mode. It is dropped by a
    restart, a fault, the begin of a pause, a drive that goes off (or is switched on again) and an
    opening that is abandoned.
    """
    if after in (State.SYNC, State.INIT):
        return before in (State.SYNC, State.INIT)
    if after is State.DRIVE_OFF:
        return before in _STATES_BEFORE_DRIVE_ON
    if after is State.DRIVING_ON:
        return before in _STATES_BEFORE_DRIVE_ON or before is State.DRIVING_ON
    if after is State.CLOSED:
        return before not in STATES_WITH_SET_POINTS
    if after is State.FREEZING:
        return before is State.FREEZING
    return after in (State.OPENING, State.OPEN)


_LOSS: Final = {
    Input.SYNC: "the controller restarted: it sent a sync packet",
    Input.INIT: "the controller restarted: it sent an init packet",
    Input.OFF: "the drive went off",
    Input.DRIVING_ON: "the drive was switched on again",
    Input.CLOSED: "the controller closed open mode",
    Input.PARTLY_OPEN: "axes were open before the controller reported them closed",
    Input.OPEN: "axes were open before the controller reported them closed",
    Input.PAUSE: "the controller paused the exchange",
    Input.UNAVAILABLE: "the controller reports an unknown mode",
    Input.END: "the controller ended the session",
    Input.SILENCE: "nothing was received from the controller",
}
"""Reason for the loss of a motion."""


@dataclass(frozen=True, eq=False)
class AxesReport:
    """What a packet says of the axes of an arm.

    Attributes:
        input: of the state machine.
        status: of the arm's drive, as the controller codes it.
        modes: (n,) mode of each joint, likewise.
        ready: (n,) joints in the wanted mode; closed ones where they are to stay closed.
        held_joints: (n,) joints in an open mode whose safe reply is the target received.
        powered: some wanted axis is in an open mode and the drive is on.
        any_open: some wanted axis is in an open mode.
        unwanted: first joint in an open mode other than the wanted one, or None.
        cause: what ends a motion that this input ends, as the controller states it; "" where the
            input says it all.
        remedy: what the operator should do then; "" for the remedy of the refusal.
    """

    input: Input
    status: int
    modes: NDArray[np.int32]
    ready: NDArray[np.bool_]
    held_joints: NDArray[np.bool_]
    powered: bool
    any_open: bool
    unwanted: int | None
    cause: str
    remedy: str

    @property
    def fault(self) -> str:
        """Why these modes are refused."""
        return self.cause

    def misplacement(self, joint: int) -> str:
        """Return why a joint, from 0, is not in the mode that the motion needs."""
        return self.cause or f"joint {joint + 1} is in mode {self.modes[joint]}"

    def misplaced(self, in_motion: bool) -> int | None:
        """Return a joint that is not in the mode a requested motion needs, or None.

        Before the motion an axis may still be closed; `in_motion` every one has to be open.
        """
        if not self.powered:
            return None
        if in_motion and self.input is not Input.OPEN:
            return int(np.argmin(self.ready))
        return self.unwanted


class RequestedMotion(Protocol):
    """What a decision reads of the requested motion, an `Execution`."""

    @property
    def started(self) -> bool:
        """Whether its first set-point was sent."""

    @property
    def leaving(self) -> bool:
        """Whether it came to rest and open mode is being left."""

    @property
    def outcome(self) -> Outcome:
        """Outcome once open mode has been left."""

    @property
    def reason(self) -> str:
        """Reason of that outcome."""


class AxisModes(Protocol):
    """What a decision reads of the modes of the axes, an `AxesReport`."""

    def misplaced(self, in_motion: bool) -> int | None:
        """Return a joint that is not in the mode a requested motion needs, or None."""


@dataclass(frozen=True)
class Decision:
    """What an input does to a session.

    Attributes:
        state: the next one.
        stop: why the motion is to come to rest, or is dropped if it has not begun; or None.
        ending: outcome and reason of a motion that the next state does not allow, or None.
        misplaced: joint, from 0, because of whose mode the motion is refused, or None.
    """

    state: State
    stop: str | None = None
    ending: tuple[Outcome, str] | None = None
    misplaced: int | None = None


_STAY: Final = {state: Decision(state) for state in State}


def decide(
    state: State,
    cause: Input,
    losses: LossTracker,
    motion: RequestedMotion | None,
    axes: AxisModes | None = None,
) -> Decision:
    """Return what an input does in this state; changes nothing.

    Args:
        state: before it.
        cause: the input.
        losses: before the packet, or before the silence.
        motion: the requested one, or None.
        axes: modes of a cyclic packet's axes; None for other inputs.
    """
    stop = None
    if axes is not None and motion is not None:
        if state is State.OPEN:
            stop = losses.reason_to_stop
        if stop is not None and not motion.started:
            motion = None
    if axes is not None and motion is not None:
        joint = axes.misplaced(motion.started and state is State.OPEN)
        if joint is not None:
            return Decision(TRANSITIONS[state][Input.REFUSAL], misplaced=joint)
    after = TRANSITIONS[state][cause]
    ending = None if motion is None else _ending(state, cause, after, losses, motion)
    if after is state and stop is None and ending is None:
        return _STAY[state]
    return Decision(after, stop, ending)


def _ending(
    before: State, cause: Input, after: State, losses: LossTracker, motion: RequestedMotion
) -> tuple[Outcome, str] | None:
    """Return outcome and reason of a motion that this transition ends, or None."""
    if cause in (Input.REFUSAL, Input.EXIT):
        return None  # the session states the error, and stops before it leaves
    if not motion.started:
        # After such a silence the request may be outdated, whatever the controller does next.
        if cause is not Input.SILENCE and keeps_request(before, after):
            return None
    elif after in STATES_WITH_SET_POINTS:
        return None
    elif motion.leaving:
        return motion.outcome, motion.reason
    reason = losses.instead_of_packets if cause is Input.SILENCE else ""
    return "lost", reason or _LOSS[cause]
