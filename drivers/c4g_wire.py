"""C4G Open as a session sees it: packets classified, the safe reply to each, replies built.

The safe reply is the one that an independent program gave on real robots (facts on the C4G Open
wire, section 6): everything echoed while the drive is off, target position and velocity returned in
modes 501 and 0, a mode that is not available replied to with mode 0 and zeros. An axis in an open
mode without motion gets the target received, at zero velocity; zeros where the reply would be a
correction, with any status byte, because an echo would make an offset of a position. Each axis is
handled by its own mode, because axes change modes in different cycles.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.arrays import Array
from drivers.c4g_packets import (
    AXIS_LENGTH,
    DRIVE_ON,
    EXIT_FROM_OPEN,
    HEADER_LENGTH,
    INIT_LENGTH,
    INIT_NUMBER,
    LAST_NUMBER,
    MAX_AXES,
    N_ARMS,
    CyclicPacket,
    InitPacket,
    Mode,
    OpenAxis,
    PacketSequence,
    cyclic_length,
    echo,
    is_init,
    next_number,
    packet_number,
)
from drivers.drive_train import DriveTrain, MotorSide
from drivers.errors import PacketError, RefusalError
from drivers.events import InitReceived
from drivers.guard import Joints
from drivers.init_check import verify_controller
from drivers.packet_losses import LossTracker
from drivers.states import (
    CLOSED_MODES,
    HOLDABLE_MODES,
    INCREMENTAL_MODES,
    KNOWN_MODES,
    OPEN_MODES,
    AxesReport,
    Input,
    State,
    read_input,
)
from drivers.wire import (
    ArmSettings,
    Handshake,
    MeasuredCycle,
    PacketSort,
    Received,
    Repeated,
    Stale,
)

Words = NDArray[np.int32]
Floats = NDArray[np.float32]

WORDS_PER_AXIS: Final = AXIS_LENGTH // 4
_ALL_BITS: Final = -1
# Columns of an axis block seen as nine 4-byte words.
MODE, D1, D2, D3, D4, D5 = range(6)

_HEADER: Final = struct.Struct("<i4sI")
_SYNC_AFTER_INIT: Final = (INIT_NUMBER + 1, INIT_NUMBER + 2)
_POWERED: Final = bytes((DRIVE_ON, 0, 0, 0))
_RETURNED_WORDS: Final[dict[int, tuple[int, ...]]] = {
    Mode.CLOSED: (D1, D2),
    Mode.DRIVING_ON: (D1, D2),
    Mode.CLOSED_MIRRORED: (D1, D2, D3, D4, D5),
    **dict.fromkeys(HOLDABLE_MODES, (D1,)),
    **dict.fromkeys(INCREMENTAL_MODES, ()),
}


@dataclass(frozen=True, eq=False)
class SafeReply:
    """Safe reply to every packet with certain status bytes and modes.

    Attributes:
        status: 4 bytes.
        modes: (n,) modes of the reply.
        mask: (n, 9) all bits set in the words that are returned as received, none elsewhere.
        held_slots: slots in an open mode with their drive on whose target is returned.
    """

    status: bytes
    modes: Words
    mask: Words
    held_slots: tuple[int, ...]


def safe_reply(status: bytes, modes: Words, arms: Sequence[int] | None) -> SafeReply:
    """Compute the safe reply to 4 status bytes and modes (n,).

    `arms` is the arm of each slot, from 1; None if unknown: every drive counts as on if any is.
    """
    n = len(modes)
    on = [byte == DRIVE_ON for byte in status]
    if arms is None:
        arms = (1,) * n
        on = [any(on)] * N_ARMS
    replied = np.zeros(n, np.int32)
    mask = np.zeros((n, WORDS_PER_AXIS), np.int32)
    held_slots = []
    for slot in range(n):
        mode = int(modes[slot])
        if not on[arms[slot] - 1] and mode not in INCREMENTAL_MODES:
            replied[slot] = mode
            mask[slot, D1:] = _ALL_BITS
        elif mode in _RETURNED_WORDS:
            replied[slot] = mode
            mask[slot, list(_RETURNED_WORDS[mode])] = _ALL_BITS
            if mode in HOLDABLE_MODES:
                held_slots.append(slot)
    reply_status = bytes(
        status[arm - 1] if arm in arms and not on[arm - 1] else 0 for arm in range(1, N_ARMS + 1)
    )
    return SafeReply(reply_status, replied, mask, tuple(held_slots))


def words_of(packet: CyclicPacket) -> Words:
    """Return the axis blocks as (n, 9) words, a view, which preserves NaN payloads."""
    return packet.axes.view(np.int32).reshape(-1, WORDS_PER_AXIS)


class ReplyBuilder:
    """Builds the replies to one controller, 12 + 36 n bytes each, in place.

    `fill_safe` or `fill_refusal` begins a reply, `finish` ends it; set-points are written into
    `floats` in between.

    Args:
        n_axes: slots of the controller's packets.
        arm: the arm that is moved, from 1.
        axes: open axes by the controller's map; none if that is invalid.

    Attributes:
        floats: the axis blocks as (n, 9) numbers.
    """

    def __init__(self, n_axes: int, arm: int, axes: Sequence[OpenAxis] = ()) -> None:
        self._buffer = bytearray(cyclic_length(n_axes))
        words: Words = np.frombuffer(self._buffer, np.int32, offset=HEADER_LENGTH)
        self._words = words.reshape(n_axes, WORDS_PER_AXIS)
        self.floats: Floats = self._words.view(np.float32)
        self._arm = arm
        self._axis_of = {axis.slot: (axis.arm, axis.axis) for axis in axes}
        self._status = bytes(N_ARMS)

    def fill_safe(self, reply: SafeReply, received: Words) -> None:
        """Fill in the safe reply in every slot."""
        np.bitwise_and(received, reply.mask, out=self._words)
        self._words[:, MODE] = reply.modes
        self._status = reply.status

    def fill_refusal(self, reply: SafeReply, received: Words, offending: int | None) -> None:
        """Report a following error, 508, in slot `offending`, or request drive-off, 505, in all.

        Targets received are returned in case they are used. With a 508 open axes hold theirs, so
        each must be finite; otherwise drive-off is requested.
        """
        self.fill_safe(reply, received)
        data = self.floats[:, D1:]
        data[~np.isfinite(data)] = 0.0
        targets = received.view(np.float32)[list(reply.held_slots), D1]
        if offending is None or not np.isfinite(targets).all():
            self._words[:, MODE] = Mode.DRIVE_OFF_REQUEST
        else:
            self._words[offending, MODE] = Mode.FOLLOWING_ERROR

    def require_targets(self, slots: Sequence[int], cycle: int) -> None:
        """Require finite targets where they are returned in an open mode, in axes of any arm.

        Raises:
            RefusalError: one is not finite.
        """
        if not slots:
            return
        values = self.floats[list(slots), D1]
        bad = np.flatnonzero(~np.isfinite(values))
        if bad.size:
            arm, axis = self._axis_of.get(slots[bad[0]], (self._arm, slots[bad[0]]))
            name = f"axis {axis + 1} of arm {arm}"
            message = f"target received of {name}, which is open, is {values[bad[0]]}"
            raise RefusalError(message, cycle)

    def request_exit(self) -> None:
        """Ask for the end of open mode in the status byte of the arm."""
        status = bytearray(self._status)
        status[self._arm - 1] = EXIT_FROM_OPEN
        self._status = bytes(status)

    def finish(self, number: int) -> bytes:
        """Return the reply to packet `number`; functionality is always zero."""
        _HEADER.pack_into(self._buffer, 0, next_number(number), self._status, 0)
        return bytes(self._buffer)


@dataclass(frozen=True, eq=False)
class PacketStatus(AxesReport):
    """Status bytes and modes of a packet, interpreted.

    Attributes:
        reply: the safe reply.
        other_slots: slots in `reply.held_slots` that are not joints of the arm.
        wanted_mode: the open mode of a motion.
    """

    reply: SafeReply
    other_slots: tuple[int, ...]
    wanted_mode: int

    @property
    def fault(self) -> str:
        """Why these modes are refused, by the first unknown one, else the first open one."""
        with_reply = np.isin(self.modes, list(KNOWN_MODES))
        joint = int(
            np.argmax(np.isin(self.modes, list(OPEN_MODES)) if with_reply.all() else ~with_reply)
        )
        reason = (
            "it was not closed before" if with_reply.all() else "the reply to that mode is unknown"
        )
        return f"joint {joint + 1} is in mode {self.modes[joint]}: {reason}"

    def misplacement(self, joint: int) -> str:
        """Return the mode of a joint, from 0, and the one that the motion needs."""
        mode = int(self.modes[joint])
        wanted = int(Mode.CLOSED if mode == self.wanted_mode else self.wanted_mode)
        return f"joint {joint + 1} is in mode {mode}; the motion needs {wanted}"


class PacketClassifier:
    """Interprets status and modes of packets; caches the last, because modes rarely change.

    Args:
        slots: (n,) slot of each wanted axis; none if the arm has no open axis.
        arms: arm of each slot, from 1; None if unknown: any drive that is on counts.
        arm: the arm that is moved, from 1.
        mode: wanted open mode.
        opened: (n,) which axes are to be open; None for all.
    """

    def __init__(
        self,
        slots: NDArray[np.intp],
        arms: tuple[int, ...] | None,
        arm: int,
        mode: int,
        opened: NDArray[np.bool_] | None = None,
    ) -> None:
        self._slots = slots
        self._opened = np.ones(len(slots), dtype=np.bool_) if opened is None else opened
        self._arms = arms
        self._arm = arm
        self._mode = mode
        self._key: tuple[bytes, bytes] | None = None
        self._last: PacketStatus | None = None

    def classify(self, status: bytes, modes: Words) -> PacketStatus:
        """Interpret 4 status bytes and the modes of all slots."""
        key = (status, modes.tobytes())
        if self._last is None or key != self._key:
            self._key = key
            self._last = self._interpret(status, modes.copy())
        return self._last

    def _interpret(self, status: bytes, modes: Words) -> PacketStatus:
        wanted = modes[self._slots]
        drive_on = (DRIVE_ON in status) if self._arms is None else status[self._arm - 1] == DRIVE_ON
        is_open = np.isin(wanted, list(OPEN_MODES))
        closed = ~self._opened & np.isin(wanted, list(CLOSED_MODES))
        ready = closed | (self._opened & (wanted == self._mode))
        unwanted = np.flatnonzero(is_open & ~ready)
        reply = safe_reply(status, modes, self._arms)
        joints = set(self._slots.tolist())
        return PacketStatus(
            input=read_input(drive_on, modes.tolist(), wanted[~closed].tolist(), self._mode),
            reply=reply,
            status=status[self._arm - 1],
            modes=wanted,
            ready=ready,
            held_joints=np.isin(wanted, list(HOLDABLE_MODES)),
            powered=drive_on and bool(is_open.any()),
            any_open=bool(is_open.any()),
            unwanted=int(unwanted[0]) if unwanted.size else None,
            cause="",
            remedy="",
            other_slots=tuple(slot for slot in reply.held_slots if slot not in joints),
            wanted_mode=self._mode,
        )


@dataclass(frozen=True, eq=False)
class _Arm:
    """The arm that is moved, as the init packet describes it.

    Attributes:
        joint_slots: (n,) slot of each joint.
        opened: (n,) joints that are to be open; only these are written into a reply.
        motors: values and conversions of the motor side.
    """

    joint_slots: NDArray[np.intp]
    opened: NDArray[np.bool_]
    motors: MotorSide

    @classmethod
    def of(cls, init: InitPacket, settings: ArmSettings) -> _Arm:
        """Return the arm of an init packet in which `drivers.init_check` finds every joint open."""
        n, arm = settings.drive_train.n_joints, settings.arm
        slot_of = {axis.axis: axis.slot for axis in init.open_axes() if axis.arm == arm}
        slots = np.array([slot_of[joint] for joint in range(n)], np.intp)
        only = settings.only_axis
        opened = np.ones(n, dtype=np.bool_) if only is None else np.arange(n) == only - 1
        return cls(slots, opened, MotorSide(settings.drive_train, init.period))


class C4gWire:
    """A session's C4G Open: see `drivers.wire.Wire`."""

    reports_use = False
    _cold_start: bool
    _last_packet: bytes

    def __init__(self, settings: ArmSettings) -> None:
        self.description: InitPacket | None = None
        self.motors: MotorSide | None = None
        self.opened = np.ones(settings.drive_train.n_joints, dtype=np.bool_)
        self._settings = settings
        self._sequence = PacketSequence()
        self._number = 0

    def receive(self, packet: bytes, state: State, losses: LossTracker) -> Received:
        """Interpret a packet; see `Wire.receive`."""
        if is_init(packet):
            return self._introduced(packet, state, losses.max_gap)
        number = packet_number(packet)
        powered = DRIVE_ON in packet[4 : 4 + N_ARMS]
        if self._expects_sync(number, powered, state):
            return self._sync(packet, number, powered)
        if number < INIT_NUMBER and not powered and self._sequence.is_stale(number):
            # It gets a reply once silence has ended the session before.
            losses.restarting = True
        return self._cyclic(packet, number)

    def _introduced(self, packet: bytes, state: State, max_gap: int) -> Received:
        if state is State.INIT and packet == self._last_packet:
            return Repeated()
        settings = self._settings
        init = InitPacket.decode(packet)
        syncing = state is State.SYNC
        sequence = self._sequence
        self._cold_start = syncing and sequence.last > 0
        restarted = syncing and not sequence.leads_to(INIT_NUMBER, max_gap)
        others = frozenset(settings.other_axes)
        received = verify_controller(
            settings.drive_train, settings.period, init, settings.arm, others
        )
        self._connect(init, received)
        sequence.restart(INIT_NUMBER, settings.silence_timeout / max(init.period, 1e-3))
        self._last_packet = packet
        return Handshake(Input.INIT, echo(packet), received, restarted)

    def _connect(self, init: InitPacket, received: InitReceived) -> None:
        """Prepare for the packets of the controller that sent an init packet."""
        settings = self._settings
        arm = settings.arm
        axes: Sequence[OpenAxis] | None
        try:
            axes = init.open_axes()
        except PacketError:
            axes = None
        arms = None if axes is None else tuple(axis.arm for axis in axes)
        self.description = init
        self._builder = ReplyBuilder(init.n_axes, arm, axes or ())
        if received.unusable is not None:
            # Any axis of the arm that is open; any axis at all if the map is invalid.
            slots = range(init.n_axes) if axes is None else [a.slot for a in axes if a.arm == arm]
            joints = np.array(slots, np.intp)
            self._classifier = PacketClassifier(joints, arms, arm, settings.mode)
            self.motors = None
            return
        moved = _Arm.of(init, settings)
        self.motors, self.opened = moved.motors, moved.opened
        self._slots = slots_of = moved.joint_slots
        n = len(slots_of)
        first = int(slots_of[0])
        contiguous = np.array_equal(slots_of, np.arange(first, first + n))
        # A slice makes a view where an index array would make a copy.
        self._pick: slice | NDArray[np.intp] = slice(first, first + n) if contiguous else slots_of
        self._written: slice | NDArray[np.intp] = slice(None)
        self._written_slots = self._pick
        if settings.only_axis is not None:
            self._written = np.array([settings.only_axis - 1])
            self._written_slots = slots_of[self._written]
        self._classifier = PacketClassifier(slots_of, arms, arm, settings.mode, moved.opened)

    def _expects_sync(self, number: int, powered: bool, state: State) -> bool:
        if state is State.SYNC:
            return True
        if powered:
            return False
        if state is State.INIT:
            return self._cold_start and number in _SYNC_AFTER_INIT
        # A controller that was silent and counts from the beginning has restarted.
        sequence = self._sequence
        return sequence.broken and number < INIT_NUMBER and sequence.distance(number) != 1

    def _sync(self, packet: bytes, number: int, powered: bool) -> Handshake:
        if powered:
            # The controller is in mid-session, and an echo would send set-points to open axes.
            # Without replies its own watchdog acts.
            raise PacketError("status", packet[4 : 4 + N_ARMS].hex(), "no drive on before init")
        if len(packet) >= INIT_LENGTH:
            raise PacketError("length", len(packet), f"less than {INIT_LENGTH} bytes")
        self._sequence.accept(number)
        self._last_packet = packet
        return Handshake(Input.SYNC, echo(packet))

    def _cyclic(self, packet: bytes, number: int) -> Received:
        assert self.description is not None
        decoded = CyclicPacket.decode(packet, self.description.n_axes)
        sequence = self._sequence
        if sequence.is_duplicate(number) and packet == self._last_packet:
            return Repeated()
        if sequence.is_stale(number):
            return Stale(f"number {number} does not follow {sequence.last}")
        missed = sequence.accept(number)
        self._words = words = words_of(decoded)
        self._status = status = self._classifier.classify(decoded.status, words[:, MODE])
        self._number = number
        self._last_packet = packet
        return MeasuredCycle(number, sequence.cycle, missed, status)

    def forget(self) -> None:
        """See `Wire.forget`."""
        self.description = self.motors = None

    def lost(self) -> None:
        """See `Wire.lost`."""
        self._sequence.broken = True

    def limits(self) -> tuple[Array, Array]:
        """See `Wire.limits`; the current limit is the narrower of controller and drive train."""
        init, settings = self.description, self._settings
        assert init is not None
        joints = slice(0, settings.drive_train.n_joints)
        row = settings.arm - 1
        return (
            init.following_error[row, joints].astype(np.float64),
            np.fmin(init.current_limit[row, joints], settings.drive_train.current_limit),
        )

    def record(self, measured: Array) -> None:
        """See `Wire.record`."""
        assert self.motors is not None
        self.motors.raw[...] = self._words.view(np.float32)[self._pick, D1:].T
        self.motors.to_joints(measured)

    def fill_safe(self, requested: bool, cycle: int) -> None:
        """See `Wire.fill_safe`; the controller's operator opens the axes."""
        del requested, cycle
        self._builder.fill_safe(self._status.reply, self._words)

    def fill_refusal(self, offending: int | None) -> None:
        """Report a following error of joint `offending`, or request drive-off of all."""
        slot = None
        if offending is not None and self.motors is not None:
            slot = int(self._slots[offending])
        self._builder.fill_refusal(self._status.reply, self._words, slot)

    def require_targets(self, cycle: int) -> None:
        """See `Wire.require_targets`."""
        self._builder.require_targets(self._status.reply.held_slots, cycle)

    def require_other_targets(self, cycle: int) -> None:
        """See `Wire.require_other_targets`."""
        self._builder.require_targets(self._status.other_slots, cycle)

    def record_state(self, state: NDArray[np.void]) -> None:
        """Do nothing: its packets say no more than cycle records."""
        del state

    def not_used(self) -> int:
        """Return 0: it shows in the target."""
        return 0

    def write(self, position: Array, step: Array) -> None:
        """Write D1 and D2 of the joints that are to be open."""
        floats = self._builder.floats
        floats[self._written_slots, D1] = position[self._written]
        floats[self._written_slots, D2] = step[self._written]

    def write_rest(self, position: Array, where: Joints) -> None:
        """Write D1, with D2 zero, of the joints `where` (n,)."""
        slots = self._slots[where]
        self._builder.floats[slots, D1] = position[where]
        self._builder.floats[slots, D2] = 0.0

    def request_exit(self) -> None:
        """See `Wire.request_exit`."""
        self._builder.request_exit()

    def finish(self) -> bytes:
        """See `Wire.finish`."""
        return self._builder.finish(self._number)

    def sort(self, packet: bytes) -> PacketSort:
        """Return length, status and modes; bytes behind the open axes make no kind."""
        n = MAX_AXES if self.description is None else self.description.n_axes
        status = packet[4 : 4 + N_ARMS]
        # The lowest byte of a mode identifies it.
        modes = packet[HEADER_LENGTH : cyclic_length(n) : AXIS_LENGTH]
        number = int.from_bytes(packet[:4], "little")
        return PacketSort(is_init(packet), b"%d:" % len(packet) + status + modes, number)

    def ahead(self, later: int, earlier: int) -> int:
        """Return the difference of two packet numbers, modulo their range."""
        return (later - earlier) % LAST_NUMBER


class _OwnPackets:
    """Packets of a C4G at rest."""

    def __init__(
        self, drive_train: DriveTrain, position: Array, period: float, limits: tuple[Array, Array]
    ) -> None:
        n = drive_train.n_joints
        self._number = INIT_NUMBER
        self._axes = CyclicPacket.zeros(1, n).axes
        self._axes["d"][:, 0] = self._axes["d"][:, 2] = drive_train.motor_revolutions(position)
        wrist = [0.0, 0.0, 0.0, drive_train.k54, drive_train.k64, drive_train.k65]
        values: dict[str, ArrayLike] = {
            "gear_ratio": drive_train.gear_ratio,
            "calibration": drive_train.calibration,
            "kinematic_influence": wrist,
            "current_limit": limits[1],
            "following_error": limits[0],
        }
        self._init = InitPacket.build(n, round(1000.0 * period), values)

    def first(self) -> bytes:
        return self._init.encode()

    def next(self, *, opened: bool) -> bytes:
        self._number = next_number(self._number)
        self._axes["mode"] = Mode.POSITION if opened else Mode.CLOSED
        return CyclicPacket(self._number, _POWERED, bytes(N_ARMS), self._axes).encode()


@dataclass(frozen=True)
class C4gProtocol:
    """The protocol of C4G Open."""

    state: np.dtype[np.void] | None = None

    def wire(self, settings: ArmSettings) -> C4gWire:
        """Return the wire of a session; ValueError for an arm that does not exist."""
        if not 1 <= settings.arm <= N_ARMS:
            raise ValueError(f"arm {settings.arm} is not one of 1..{N_ARMS}")
        return C4gWire(settings)

    def own_packets(
        self, drive_train: DriveTrain, position: Array, period: float, limits: tuple[Array, Array]
    ) -> _OwnPackets:
        """See `ControllerProtocol.own_packets`."""
        return _OwnPackets(drive_train, position, period, limits)
