"""Simulated controller with servo loops and arm, in virtual time.

`next_packet()` returns the packet of a cycle, `accept(reply)` processes the reply of the PC and
simulates one period. There is no clock, thread or file; one seed gives bit-identical runs.

Cycle k begins at t_k, with period T:

    t_k             encoders are read; packet k has them as D3, and as D5 the target current that
                    the servo computed at t_(k-1) from the positions of packet k-1
    after t_k       the reply has the target for t_(k+1); the servo computes its current
    t_k .. t_(k+1)  the plant moves under that current, which follows with a lag of tau

In a cycle longer than 1 ms the loops of the servo run each millisecond, with set-points in between
and encoder positions of their own; the current of the packet is their mean.

The current in packet k acted from t_(k-1) to t_k, on average at t_k - T/2 + tau. So the current
that belongs to the position of packet k is recorded `current_delay_cycles` = 1/2 - tau/T cycles
later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum, auto
from itertools import chain
from math import ceil, copysign, isfinite
from operator import gt
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.c4g_packets import (
    AXIS_DTYPE,
    DRIVE_ON,
    EXIT_FROM_OPEN,
    MAX_AXES,
    MAX_CYCLIC_LENGTH,
    N_ARMS,
    NO_SLOT,
    CyclicPacket,
    InitPacket,
    Mode,
    next_number,
    packet_number,
)
from drivers.errors import PacketError
from sim_fixtures.arm import DisturbanceKind, SimulatedArm, UnmodelledEffects
from sim_fixtures.arrays import Array
from sim_fixtures.drive import SimulatedDrive
from sim_fixtures.faults import InjectedFault
from sim_fixtures.plant import Carried, PlantTruth
from sim_fixtures.servo import CycleDemand, CycleServo, NominalModel
from sim_fixtures.settings import AXES_PER_ARM, ControllerSettings, SettingError

_PC_TARGETS = (1, 4, 5)
_FOREIGN = {
    "calibration": 0.5,
    "current_limit": 10.0,
    "gear_ratio": 100.0,
    "following_error": 2.0,
}
"""Init packet entries of each axis of other arms."""


class Phase(IntEnum):
    """State of the program; from DRIVING_ON to CLOSING the drive is on."""

    START = auto()
    DRIVE_OFF = auto()
    DRIVING_ON = auto()
    CLOSED = auto()
    MOVING = auto()
    PAUSED = auto()
    OPENING = auto()
    OPEN = auto()
    CLOSING = auto()
    TRIPPED = auto()
    SHUTDOWN = auto()
    ENDING = auto()
    ENDED = auto()


POWERED_PHASES = frozenset(phase for phase in Phase if Phase.DRIVING_ON <= phase <= Phase.CLOSING)
UNBRAKED_PHASES = POWERED_PHASES - {Phase.DRIVING_ON}
STILL_OPEN_PHASES = frozenset({Phase.CLOSING, Phase.TRIPPED})
"""Phases whose first cycles report the previous modes."""
OPEN_AXES_PHASES = frozenset({Phase.OPENING, Phase.OPEN, Phase.CLOSING})
LISTENING_PHASES = frozenset({Phase.OPENING, Phase.OPEN})


_COLD_START = (False,) * 9 + (True, False, False)
"""Whether each packet of a cold start is the init packet; a warm one has no other."""


def _cycles(count: int) -> str:
    return "1 cycle" if count == 1 else f"{count} cycles"


class Requests(NamedTuple):
    """Requests in one reply of the PC.

    A `valid` reply has the right number and length; `exit` requests the end of open mode (status
    byte 1), `drive_off` is mode 505 on some axis, `following_error` mode 508.
    """

    valid: bool = False
    exit: bool = False
    drive_off: bool = False
    following_error: bool = False


MISSING = Requests()


class LoopProgram:
    """State machine of the program on the controller, cycle by cycle.

    The program starts the link, switches the drive on, opens the axes one after the other, waits
    for the end of open mode, closes the axes and opens them again. Its input is the content of one
    reply per cycle.

        START -> DRIVE_OFF -> DRIVING_ON -> CLOSED -> OPENING -> OPEN -> CLOSING -+
                      ^           ^           ^                                   |
                      |           |           +-----------------------------------+
        TRIPPED (drive lost, axes still open for some cycles) -> DRIVE_OFF
        PAUSED (modes 500 or 502 for some cycles) -> CLOSED
        finish() or the last interval: CLOSED -> SHUTDOWN -> ENDING (504) -> ENDED
        a motion of the controller's own, with closed axes: CLOSED -> MOVING -> CLOSED -> SHUTDOWN

    The program opens `wanted_axes` (n,); `open_axes` (n,) are in open mode in the packet of this
    cycle, and their targets are read from the PC while it is `listening`. `reason` is that of the
    last loss of the drive or of the end of the session, `end_packet` what became of
    the packet with 504: "none" was sent, "unanswered" or "replied".
    `intervals` counts the openings of all wanted axes, `openings_lost` consecutive ones that ended
    by missing replies or 508; the session ends because of too many of these if `gave_up`.
    """

    def __init__(self, n_axes: int, settings: ControllerSettings) -> None:
        self._settings = settings
        self._n_axes = n_axes
        only = settings.only_axis
        if only is not None and only > n_axes:
            raise SettingError("only_axis", only, f"1..{n_axes}")
        self.wanted_axes = [only in (None, axis + 1) for axis in range(n_axes)]
        self._start = _COLD_START if settings.cold_start else (True,)
        self._age = 0
        self._missed = 0
        self._missed_open = 0
        self._reopens_at = 0
        self._stays_off = False
        self._finishing = False
        self._moves = bool(settings.own_motion) and not settings.corrected
        self._own_motion_over = False
        self._gone: set[int] = set()
        self._pause_cycles = 0
        self.pause_mode = 0
        self.reason = ""
        self.intervals = 0
        self.openings_lost = 0
        self.gave_up = False
        self.end_packet: Literal["none", "unanswered", "replied"] = "none"
        self._enter(Phase.START)

    @property
    def at_init(self) -> bool:
        """Whether the present packet in phase START is the init packet."""
        return self._start[self._age]

    def finish(self) -> None:
        """End the session, immediately or when open axes are at rest."""
        self._finishing = True

    def drive_on(self) -> None:
        """Press the drive-on button after the drive was lost."""
        self._stays_off = False

    def trip(self, reason: str) -> None:
        """Lose the drive now, as at a following error or an emergency stop."""
        if self.powered:
            self.reason = reason
            self.openings_lost = 0
            self._stays_off = True
            self._own_motion_over = self._own_motion_over or self.phase is Phase.MOVING
            opened = self.phase in OPEN_AXES_PHASES
            self._enter(Phase.TRIPPED if opened else Phase.DRIVE_OFF)

    def axis_leaves(self, axis: int) -> None:
        """Close one axis (0-based) while the others stay open."""
        if self.phase in OPEN_AXES_PHASES:
            self._gone.add(axis)
            self.open_axes[axis] = False

    def pause(self, mode: int, cycles: int) -> None:
        """Report a pause, mode 500 or 502, for some cycles if the drive is on."""
        if self.powered and self.phase is not Phase.DRIVING_ON:
            self.pause_mode = mode
            self._pause_cycles = cycles
            self._enter(Phase.PAUSED)

    def restarted(self, settings: ControllerSettings) -> LoopProgram:
        """Return the program after a restart, with the drive off."""
        program = LoopProgram(self._n_axes, settings)
        program._stays_off = True
        program.reason = "the controller was restarted"
        return program

    def advance(self, requests: Requests, at_rest: bool, own_motion_done: bool = False) -> None:
        """End the cycle; `at_rest` means that the targets of all axes are at rest."""
        self._age += 1
        self._missed = 0 if requests.valid else self._missed + 1
        if self._missed >= self._settings.silence_limit and self.phase < Phase.SHUTDOWN:
            self.reason = f"no valid reply in {self._missed} cycles"
            self._enter(Phase.SHUTDOWN)
        elif self.phase is Phase.START:
            self._advance_start(requests)
        elif self.listening:
            self._advance_open(requests, at_rest)
        elif self.phase is Phase.MOVING:
            if own_motion_done:
                self._own_motion_over = True
                self._enter(Phase.CLOSED)
        else:
            self._advance_timed(at_rest)

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self.powered = phase in POWERED_PHASES
        self.braked = phase not in UNBRAKED_PHASES
        self.listening = phase in LISTENING_PHASES
        self._age = 0
        if phase is Phase.OPENING:
            self._missed_open = 0
            self._gone.clear()
            self._open_due_axes()
        elif phase not in STILL_OPEN_PHASES:
            self.open_axes = [phase is Phase.OPEN and wanted for wanted in self.wanted_axes]

    def _open_due_axes(self) -> None:
        """Open one axis after the other."""
        stagger = self._settings.opening_stagger
        wanted = self.wanted_axes
        self.open_axes = [
            wanted[axis] and axis not in self._gone and self._age >= sum(wanted[:axis]) * stagger
            for axis in range(self._n_axes)
        ]

    def _close_due_axes(self) -> None:
        """Close one axis after the other."""
        settings = self._settings
        age = self._age
        self.open_axes = [
            is_open and age < settings.closing_cycles + i * settings.closing_stagger
            for i, is_open in enumerate(self.open_axes)
        ]

    def _advance_start(self, requests: Requests) -> None:
        """Advance through the packets of the start; an init packet without reply ends it."""
        if self._start[self._age - 1] and not requests.valid:
            self.reason = "the init packet got no reply"
            self._enter(Phase.ENDED)
        elif self._age == len(self._start):
            self._enter(Phase.DRIVE_OFF)

    def _advance_open(self, requests: Requests, at_rest: bool) -> None:
        """Process a reply while axes are open or opening."""
        settings = self._settings
        self._missed_open = 0 if requests.valid else self._missed_open + 1
        if requests.drive_off:
            self.openings_lost = 0
            self.reason = "the PC asked for drive off (505)"
            self._stays_off = True
            self._enter(Phase.DRIVE_OFF)
        elif requests.following_error:
            self._lose_opening("the PC reported a following error (508)")
        elif self._missed >= settings.missed_replies:
            self._miss_replies()
        elif requests.exit or (self._finishing and at_rest):
            self.openings_lost = 0
            self._enter(Phase.CLOSING)
        elif self.phase is Phase.OPENING:
            if self.open_axes == self.wanted_axes:
                self.intervals += 1
                self._enter(Phase.OPEN)
            else:
                self._open_due_axes()

    def _miss_replies(self) -> None:
        """End open mode because replies are missing."""
        reason = f"no valid reply in {_cycles(self._missed)} of open mode"
        if self._missed_open < self._missed:
            reason = (
                f"no valid reply in {_cycles(self._missed)} in a row, "
                f"the last {self._missed_open} of them in open mode"
            )
        if self._settings.while_silent == "drive_off":
            self.trip(reason)
        else:
            self._lose_opening(reason)

    def _lose_opening(self, reason: str) -> None:
        """End open mode; open again later, unless that happened too often."""
        settings = self._settings
        self.openings_lost += 1
        if settings.lost_openings is not None and self.openings_lost >= settings.lost_openings:
            self.gave_up = True
            reason = f"open mode was lost {self.openings_lost} times in a row: {reason}"
        self.reason = reason
        self._enter(Phase.CLOSED)
        self._reopens_at = ceil(settings.reopening_time / settings.period)

    def _advance_closed(self) -> None:
        """Leave phase CLOSED."""
        settings = self._settings
        limit = settings.open_intervals
        done = limit is not None and self.intervals >= limit
        if self._finishing or done or self._own_motion_over or self.gave_up:
            self._enter(Phase.SHUTDOWN)
        elif self._age >= self._reopens_at:
            self._reopens_at = 0
            self._enter(Phase.MOVING if self._moves else Phase.OPENING)

    def _advance_timed(self, at_rest: bool) -> None:
        """Leave the phases that last a number of cycles."""
        settings = self._settings
        phase = self.phase
        age = self._age
        if phase is Phase.DRIVE_OFF and age >= settings.drive_off_cycles:
            if self._finishing or self.gave_up:
                self._enter(Phase.ENDING)
            elif not self._stays_off:
                self._enter(Phase.DRIVING_ON)
        elif phase is Phase.DRIVING_ON and age >= settings.driving_on_cycles:
            self._enter(Phase.CLOSED)
        elif phase is Phase.CLOSED and age >= settings.closed_cycles and at_rest:
            self._advance_closed()
        elif phase is Phase.PAUSED and age >= self._pause_cycles:
            self._enter(Phase.CLOSED)
        elif phase is Phase.CLOSING:
            self._close_due_axes()
            if not any(self.open_axes):
                self._enter(Phase.CLOSED)
        elif phase is Phase.TRIPPED and age >= settings.closing_cycles:
            self._enter(Phase.DRIVE_OFF)
        elif phase is Phase.SHUTDOWN and age >= settings.drive_off_cycles:
            self._enter(Phase.ENDING)
        elif phase is Phase.ENDING:
            self.end_packet = "unanswered" if self._missed else "replied"
            self._enter(Phase.ENDED)


class Layout:
    """Axis blocks of this arm and of others, and the packets with them.

    `tail` are random bytes that fill long packets; `axes` (n_slots,) the axis blocks of the next
    packet; `slots` (and `slot_array`) the slot of each axis of this arm.
    """

    def __init__(
        self, n_axes: int, settings: ControllerSettings, tail: np.random.Generator
    ) -> None:
        self.n_slots = n = n_axes + settings.foreign_axes
        slots = settings.slots if settings.slots is not None else tuple(range(n_axes))
        self.slots = tuple(slots)
        self.slot_array = np.array(slots, np.intp)
        self._foreign = np.array([s for s in range(n) if s not in slots], np.intp)
        self._settings = settings
        self._tail = tail
        others = [arm for arm in range(N_ARMS) if arm != settings.arm - 1]
        self._foreign_arm = [others[i // AXES_PER_ARM] for i in range(settings.foreign_axes)]
        self.axes: NDArray[np.void] = np.zeros(n, AXIS_DTYPE)
        # D1..D5, extra1..3 of all slots, (8, n_slots)
        self._values = self.axes.view(np.float32).reshape(n, -1)[:, 1:].T
        self._modes: tuple[int | bool | None, ...] = ()
        # different positions of the axes of other arms
        places = np.arange(1.0, 1.0 + settings.foreign_axes) / 4.0
        self.axes["d"][self._foreign, 0] = self.axes["d"][self._foreign, 2] = places
        arms = {settings.arm - 1, *self._foreign_arm}
        self._on = bytes(DRIVE_ON if arm in arms else 0 for arm in range(N_ARMS))

    def fill(self, values: NDArray[np.float64]) -> None:
        """Set D1..D5, extra1..3 of this arm's axes, (8, n_axes); infinite beyond float32."""
        with np.errstate(over="ignore"):
            self._values[:, self.slot_array] = values

    def set_modes(self, common: int | None, open_axes: Sequence[bool]) -> None:
        """Set all modes to `common`, or if None each axis to the open mode or to closed."""
        wanted = (common, *open_axes)
        if wanted == self._modes:
            return
        self._modes = wanted
        if common is not None:
            self.axes["mode"] = common
            return
        mode = self._settings.open_mode
        self.axes["mode"][self.slot_array] = [mode if is_open else 0 for is_open in open_axes]
        opens = self._settings.foreign_open and any(open_axes)
        self.axes["mode"][self._foreign] = mode if opens else 0

    def packet(self, number: int, powered: bool) -> bytes:
        """Return the cyclic packet with the present axis blocks."""
        status = self._on if powered else bytes(N_ARMS)
        packet = CyclicPacket(number, status, bytes(N_ARMS), self.axes).encode()
        if self._settings.long_packets:
            packet += self._tail.bytes(MAX_CYCLIC_LENGTH - len(packet))
        return packet

    def move_foreign(self, reply: CyclicPacket) -> None:
        """Move open axes of other arms to the targets of the PC."""
        mode = self._settings.open_mode
        if mode not in _PC_TARGETS:
            return
        for slot in self._foreign.tolist():
            if self.axes["mode"][slot] == mode == reply.axes["mode"][slot]:
                target, delta = reply.axes["d"][slot, :2].tolist()
                self.axes["d"][slot, :4] = (target, delta, target, delta)

    def init(self, drive: SimulatedDrive, period: float) -> bytes:
        """Return the init packet (1200 bytes)."""
        settings = self._settings
        row = settings.arm - 1
        axes = (row, slice(drive.n_axes))
        shape = (N_ARMS, AXES_PER_ARM)
        tables = {name: np.zeros(shape, np.float32) for name in (*_FOREIGN, "kinematic_influence")}
        slots = np.full(shape, NO_SLOT, np.int32)
        modes = np.full(shape, -1, np.int32)
        for i, (arm, slot) in enumerate(zip(self._foreign_arm, self._foreign, strict=True)):
            at = (arm, i % AXES_PER_ARM)
            slots[at] = slot
            modes[at] = Mode.CLOSED
            for name, value in _FOREIGN.items():
                tables[name][at] = value
        slots[axes] = self.slot_array
        modes[axes] = Mode.CLOSED
        for name in _FOREIGN:
            tables[name][axes] = getattr(drive, name)
        tables["kinematic_influence"][row, 3:6] = (drive.k54, drive.k64, drive.k65)
        init = InitPacket.build(
            min(self.n_slots, AXES_PER_ARM), round(period * 1000.0), {},
            open_mode=modes, open_axes_map=slots, version=settings.version, **tables,
        )  # fmt: skip
        init.record["n_axes"] = self.n_slots
        return init.encode()


class MoveInterpolator(Protocol):
    """What generates the set-points of the controller's own moves, from rest to rest."""

    def begin(self, position: Array) -> None:
        """Rest at a position, (n,) [rad]."""

    def move_to(self, posture: Array) -> None:
        """Begin a move to a posture, (n,) [rad]."""

    def advance(self) -> tuple[Array, bool]:
        """Return the set-point of the next cycle, (n,) [rad], and whether the move ends there."""


class OwnMotion:
    """Moves of the controller's own program through postures (n,) [rad].

    The set-point of the present cycle is `position` [rad] and `velocity` [rad/s], (n,) of
    the step to it.

    Args:
        postures: joint angles (n,) [rad] each.
        moves: interpolates each move.
        period: cycle [s].
        dwell: rest in each posture [s].
        repeats: move back through the list and forth again until `end`.

    Attributes:
        at_rest: no move is in progress.
    """

    def __init__(
        self,
        postures: Sequence[Sequence[float]],
        moves: MoveInterpolator,
        *,
        period: float,
        dwell: float = 0.2,
        repeats: bool = False,
    ) -> None:
        self._postures = [np.array(posture, dtype=np.float64) for posture in postures]
        self._moves = moves
        self._period = period
        self._repeats = repeats
        self._dwell_cycles = max(1, round(dwell / period))
        self._next = 0
        self._ending = False
        self.at_rest = True

    def begin(self, position: ArrayLike) -> None:
        """Start from a position, (n,) [rad]."""
        self.position: Array = np.array(position, dtype=np.float64)
        self.velocity: Array = np.zeros_like(self.position)
        self._moves.begin(self.position)
        self._next = 0
        self._stride = 1
        self._rested = 0
        self._ending = False
        self.at_rest = True

    @property
    def finished(self) -> bool:
        """Whether the last posture was reached, or the last move after `end`."""
        done = self._ending or not 0 <= self._next < len(self._postures)
        return done and self.at_rest

    def end(self) -> None:
        """Finish the present move and start no other."""
        self._ending = True

    def advance(self) -> tuple[Array, Array]:
        """Return the set-point of the next cycle: position [rad] and velocity [rad/s], (n,)."""
        if self.at_rest and not self.finished:
            self._rested += 1
            if self._rested > self._dwell_cycles:
                self._start_move()
        if not self.at_rest:
            before = self.position
            self.position, self.at_rest = self._moves.advance()
            step = self.position - before
            self.velocity = np.zeros_like(step) if self.at_rest else step / self._period
        return self.position, self.velocity

    def _start_move(self) -> None:
        self._moves.move_to(self._postures[self._next])
        self._next += self._stride
        at_an_end = not 0 <= self._next < len(self._postures)
        if self._repeats and len(self._postures) > 1 and at_an_end:
            self._stride = -self._stride
            self._next += 2 * self._stride
        self._rested = 0
        self.at_rest = False


Numbers = Sequence[float]
Wanted = Sequence[Sequence[float] | None]
"""D1..D5 of the reply for each axis; None for an axis without a valid one."""

_ADDED_SPEED_MODES = (2, 8)
_ADDED_CURRENT_MODES = (1, 2, 9)


class Targets:
    """Computes the demand of each cycle from the own program and the replies.

    `target` and `delta` are the targets that the controller reports, (n,) [motor rev], and their
    speed [motor rev per cycle].
    """

    def __init__(
        self, drive: SimulatedDrive, settings: ControllerSettings, own_motion: OwnMotion | None
    ) -> None:
        n = drive.n_axes
        self._drive = drive
        self._settings = settings
        self._motion = own_motion
        self._moving = False
        self._broken_off = False
        self._offset = [0.0] * n
        self._ramp = [0.0] * n
        self.target = [0.0] * n
        self.delta = [0.0] * n

    @property
    def own_motion_done(self) -> bool:
        """Whether the own motion is finished, or there is none."""
        return self._motion is None or self._motion.finished

    def release(self, servo: CycleServo) -> None:
        """With the drive off, set targets to the motor positions and abort the own motion."""
        self.target = list(servo.target)
        self.delta = list(servo.delta)
        self._offset = [0.0] * len(self.target)
        self._break_off()

    def _break_off(self) -> None:
        """Abort an own motion in progress."""
        self._broken_off = self._broken_off or self._moving
        self._moving = False

    def end_own_motion(self) -> None:
        """Finish the present own move and start no other."""
        if self._motion is not None:
            self._motion.end()

    def advance(self, servo: CycleServo, program: LoopProgram, wanted: Wanted) -> CycleDemand:
        """Return the demand of the cycle that begins, with the PC's reply `wanted` (n,)."""
        demand = self._own_demand(servo, program)
        if self._settings.corrected and program.listening:
            self.target = list(demand.target)
            self.delta = list(demand.delta)
            self._correct(demand, wanted)
        else:
            if not self._settings.corrected:
                self._follow(demand, wanted)
            self.target = demand.target
            self.delta = demand.delta
            self._offset = [0.0] * len(self.target)
        return demand

    def _own_demand(self, servo: CycleServo, program: LoopProgram) -> CycleDemand:
        """Return the demand without a reply."""
        n = self._drive.n_axes
        zero = [0.0] * n
        corrected = self._settings.corrected and program.listening
        if self._moves_itself(program):
            return CycleDemand(*self._own_move(), zero, list(zero))
        if not program.powered:
            self._break_off()
        self._moving = False
        if corrected:
            return CycleDemand(list(self.target), list(zero), zero, list(zero))
        continues = self._settings.while_silent == "continue"
        target = list(servo.target)
        delta = [0.0] * n
        for i, before in enumerate(servo.delta):
            if before == 0.0 or not continues:
                self._ramp[i] = 0.0
                continue
            delta[i] = self._slow_down(i, before, program)
            target[i] += 0.5 * (before + delta[i])
        return CycleDemand(target, delta, zero, list(zero))

    def _slow_down(self, axis: int, before: float, program: LoopProgram) -> float:
        """Return the speed after `before` of an axis without a target in this cycle."""
        if program.listening and program.open_axes[axis]:
            self._ramp[axis] = 0.0
            return before
        if self._ramp[axis] == 0.0:
            self._ramp[axis] = abs(before) * self._settings.period / self._settings.ramp_time
        return copysign(max(0.0, abs(before) - self._ramp[axis]), before)

    def _moves_itself(self, program: LoopProgram) -> bool:
        """Whether the own motion advances in this cycle."""
        phase = Phase.OPEN if self._settings.corrected else Phase.MOVING
        return self._motion is not None and not self._broken_off and program.phase is phase

    def _own_move(self) -> tuple[list[float], list[float]]:
        """Return the next target of the own motion and its speed."""
        assert self._motion is not None
        if not self._moving:
            self._moving = True
            self._motion.begin(self._drive.joint_angles(self.target))
        position, velocity = self._motion.advance()
        period = self._settings.period
        target = self._drive.motor_revolutions(position.tolist())
        return target, [period * v for v in self._drive.motor_speeds(velocity.tolist())]

    def _follow(self, demand: CycleDemand, wanted: Wanted) -> None:
        """Replace the controller's targets by the PC's."""
        feeds = self._settings.open_mode == 1
        for i, fields in enumerate(wanted):
            if fields is None:
                continue
            demand.target[i] = fields[0]
            demand.delta[i] = fields[1]
            self._ramp[i] = 0.0
            if feeds:
                demand.speed[i] = fields[3] - fields[1]
                demand.current[i] = fields[4]

    def _correct(self, demand: CycleDemand, wanted: Wanted) -> None:
        """Apply the PC's corrections to the controller's targets."""
        mode = self._settings.open_mode
        for i, fields in enumerate(wanted):
            before = self._offset[i]
            if fields is not None:
                if mode == 7:
                    self._offset[i] = fields[0]
                if mode in _ADDED_SPEED_MODES:
                    demand.speed[i] = fields[3]
                if mode in _ADDED_CURRENT_MODES:
                    demand.current[i] = fields[4]
            demand.target[i] += self._offset[i]
            demand.delta[i] += self._offset[i] - before


EARTH_GRAVITY = (0.0, 0.0, -9.81)
NO_EFFECTS = UnmodelledEffects()

_COMMON_MODE = {Phase.DRIVING_ON: Mode.DRIVING_ON, Phase.ENDING: Mode.END_OF_SESSION}


class SimulatedController:
    """A simulated C4G with its robot, just powered up, at rest with closed brakes.

    Args:
        urdf: URDF text; the true inertias are these times `truth.inertia_scale`.
        drive: true drive train, used by servo and plant.
        truth: rotor inertias, friction and link inertias of the plant.
        settings: cycle, noise, gains, timing.
        seed: of the model errors, the noise and the phases of the ripple.
        session: number of earlier power-ups of the same controller; each has other noise.
        effects: unmodelled effects, none by default.
        initial_position: joint angles [rad]; zero by default.
        gravity: m/s2 in the base frame.
        stated: drive train in the init packet, in place of `drive`.
        entered: payload that the operator has entered, in the frame of its joint.
        faults: faults of controller and robot, by packet number.
        moves: interpolates the moves of its own program; none without one.

    Raises:
        SettingError: sizes that do not match, a fault of an axis that the arm does not have, or
            postures of an own program without `moves`.
    """

    def __init__(
        self,
        urdf: str,
        drive: SimulatedDrive,
        truth: PlantTruth,
        settings: ControllerSettings,
        *,
        seed: int,
        session: int = 0,
        effects: UnmodelledEffects = NO_EFFECTS,
        initial_position: ArrayLike | None = None,
        gravity: ArrayLike = EARTH_GRAVITY,
        stated: SimulatedDrive | None = None,
        entered: Carried | None = None,
        faults: Sequence[InjectedFault] = (),
        moves: MoveInterpolator | None = None,
    ) -> None:
        n = drive.n_axes
        if truth.n_joints != n or n > AXES_PER_ARM:
            raise SettingError("drive", f"{n} axes", f"{truth.n_joints}, at most {AXES_PER_ARM}")
        streams = np.random.default_rng(seed).spawn(3 + session)
        model_rng, noise_rng, tail_rng = streams[:3]
        noise_rng = streams[-1] if session else noise_rng
        self.truth = truth
        self.settings = settings
        self.period = settings.period
        self.rejected_replies = 0
        self._drive = drive
        self._stated = stated if stated is not None else drive
        self._arm = SimulatedArm(
            urdf, drive, truth, settings,
            effects=effects, gravity=gravity, position=initial_position, rng=noise_rng,
        )  # fmt: skip
        self.plant = self._arm.plant
        gains = settings.servo
        resolution = settings.current_resolution
        model = NominalModel(
            urdf, truth, gravity=gravity, error=gains.model_error, rng=model_rng, entered=entered
        )
        self.servo = CycleServo(
            drive, model, gains, period=settings.period, current_resolution=resolution
        )
        self.servo.start_at(self._arm.encoders())
        self._layout = Layout(n, settings, tail_rng)
        self._targets = Targets(drive, settings, self._own_motion(moves))
        self._targets.release(self.servo)
        self._faults = self._schedule(faults)
        self._cycle = 0
        self._silent = 0
        self.program = LoopProgram(n, settings)
        self._number = 1 if settings.cold_start else 10
        self._nothing: Wanted = (None,) * n
        self._awaiting = False

    def _own_motion(self, moves: MoveInterpolator | None) -> OwnMotion | None:
        settings = self.settings
        if not settings.own_motion:
            return None
        if moves is None:
            raise SettingError("own_motion", settings.own_motion, "those with `moves` between them")
        return OwnMotion(
            settings.own_motion,
            moves,
            period=settings.period,
            repeats=settings.own_motion_repeats,
        )

    def _schedule(self, faults: Sequence[InjectedFault]) -> dict[int, list[InjectedFault]]:
        schedule: dict[int, list[InjectedFault]] = {}
        for fault in faults:
            if not 1 <= getattr(fault, "axis", 1) <= self._drive.n_axes:
                raise SettingError("faults", fault, f"axes 1..{self._drive.n_axes}")
            schedule.setdefault(fault.cycle, []).append(fault)
        return schedule

    @property
    def phase(self) -> Phase:
        """Phase of the loop program."""
        return self.program.phase

    @property
    def reason(self) -> str:
        """Reason of the last loss of the drive or of the end of the session; "" if neither."""
        return self.program.reason

    @property
    def current_delay_cycles(self) -> float:
        """Cycles by which the current lags its position in the recording, without `effects`."""
        return 0.5 - self.settings.servo.current_lag / self.period

    def finish(self) -> None:
        """End the session when the arm is at rest: drive off, 504, no more packets."""
        self.program.finish()
        self._targets.end_own_motion()

    def drive_on(self) -> None:
        """Press the drive-on button after the drive was lost."""
        self.program.drive_on()

    def lose_drive(self, reason: str) -> None:
        """Switch the drive off for a reason and close the brakes."""
        self.program.trip(reason)

    def restart(self, *, warm: bool) -> None:
        """Restart: cold after `boot_time` of silence, warm with the init packet immediately."""
        self.program = self.program.restarted(replace(self.settings, cold_start=not warm))
        self._number = 10 if warm else 1
        self._silent = 0 if warm else round(self.settings.boot_time / self.period)

    def disturb(self, kind: DisturbanceKind, axis: int, size: float, cycles: int) -> None:
        """Disturb one axis; see `Disturbances.begin`.

        Args:
            kind: of the disturbance.
            axis: from 1.
            size: of a slip relative to its threshold, else as there.
            cycles: that it lasts.
        """
        if kind == "slip":
            size *= self._drive.following_error[axis - 1]
        self._arm.disturbances.begin(kind, axis - 1, size, cycles)

    def next_packet(self) -> bytes | None:
        """Return the packet of the cycle that begins; None after the end of the session.

        It is empty while the controller boots. A packet without `accept` counts as without reply.
        """
        if self._awaiting:
            self.accept(None)
        for fault in self._faults.get(self._cycle, ()):
            fault.apply_to(self)
        self._cycle += 1
        phase = self.program.phase
        if phase is Phase.ENDED:
            return None
        self._awaiting = True
        if self._silent:
            return b""
        if phase is not Phase.START:
            return self._cyclic_packet(phase)
        if self.program.at_init:
            return self._layout.init(self._stated, self.period)
        return CyclicPacket.zeros(self._number, MAX_AXES).encode()

    def accept(self, reply: bytes | None) -> None:
        """Process the reply to the last packet (None if none came) and simulate one period."""
        if not self._awaiting:
            return
        self._awaiting = False
        if self._silent:
            self._silent -= 1
            self._run(CycleDemand([], [], [], []))
            return
        requests, wanted = self._read(reply) if reply is not None else (MISSING, self._nothing)
        demand = self._targets.advance(self.servo, self.program, wanted)
        if not all(map(isfinite, chain(*demand))):
            self.program.trip("the PC sent a number that is not finite")
        done = self._targets.own_motion_done
        self.program.advance(requests, not any(demand.delta), done)
        self._run(demand)
        self._number = next_number(self._number)

    def _run(self, demand: CycleDemand) -> None:
        """Simulate the arm for one period and read its encoders."""
        servo = self.servo
        program = self.program
        if program.powered:
            self._arm.begin_cycle(braked=program.braked)
            servo.run_cycle(demand, self._arm.run)
            self._arm.end_cycle()
            self._check_following_error()
        else:
            self._arm.run_unpowered_cycle()
            servo.measure(self._arm.encoders())
            servo.release()
            self._targets.release(servo)

    def _check_following_error(self) -> None:
        """Switch the drive off if an axis exceeds its threshold."""
        thresholds = self._drive.following_error
        errors = self.servo.following_error()
        if not any(map(gt, map(abs, errors), thresholds)):
            return
        for axis, (error, threshold) in enumerate(zip(errors, thresholds, strict=True), start=1):
            if abs(error) > threshold:
                self.program.trip(
                    f"following error of axis {axis}: {error:.3f} motor revolutions, "
                    f"threshold {threshold:g}"
                )

    def _read(self, reply: bytes) -> tuple[Requests, Wanted]:
        """Decode a reply: its requests, and the fields of each open axis."""
        program = self.program
        layout = self._layout
        try:
            if packet_number(reply) != next_number(self._number):
                raise PacketError("number", packet_number(reply), "that of this cycle")
            if program.phase is Phase.START:
                return Requests(valid=True), self._nothing
            packet = CyclicPacket.decode(reply, layout.n_slots)
        except PacketError:
            self.rejected_replies += 1
            return MISSING, self._nothing
        modes: list[int] = packet.axes["mode"].tolist()
        requests = Requests(
            valid=True,
            exit=packet.status[self.settings.arm - 1] == EXIT_FROM_OPEN,
            drive_off=Mode.DRIVE_OFF_REQUEST in modes,
            following_error=Mode.FOLLOWING_ERROR in modes,
        )
        if requests.drive_off or requests.following_error or not program.listening:
            return requests, self._nothing
        layout.move_foreign(packet)
        replied = packet.axes["d"][layout.slot_array].tolist()
        open_mode = self.settings.open_mode
        return requests, [
            fields if is_open and modes[slot] == open_mode else None
            for is_open, slot, fields in zip(program.open_axes, layout.slots, replied, strict=True)
        ]

    def _cyclic_packet(self, phase: Phase) -> bytes:
        """Return the cyclic packet of the present cycle."""
        servo = self.servo
        program = self.program
        layout = self._layout
        common = program.pause_mode if phase is Phase.PAUSED else _COMMON_MODE.get(phase)
        layout.set_modes(common, program.open_axes)
        zero = [0.0] * self._drive.n_axes
        has_target = program.powered or phase is Phase.TRIPPED
        demanded = (self._targets.target, self._targets.delta) if has_target else (zero, zero)
        measured: Sequence[float] = servo.measured
        slip = self._arm.disturbances.slip
        if slip is not None:
            measured = (slip + measured).tolist()
        d = (*demanded, measured, servo.measured_delta, servo.current)
        layout.fill(np.array((*d, servo.model_current, servo.inertia, zero)))
        return layout.packet(self._number, program.powered)
