"""RTDE as a session sees it: each frame of outputs is a cycle, each reply a frame of inputs.

The first packet is a `UrDescription`. While `drivers.ur.script` runs, the set-point that it states
to have used takes the place of the controller's target, so that guard and losses see what the arm
was really commanded, at the cycle in which it was.

======================================================  ============================================
the controller reports                                  input of the state table
======================================================  ============================================
`robot_mode` without power, or without released brakes  the drive is off, or being switched on
safety mode "safeguard stop", a paused program          a pause: the motion is dropped for good
any other safety mode but "normal"                      a mode that is not available: a fault
its program waits for set-points, or ends as asked      partly open
its program stops the arm by itself                     a mode that is not available: a fault
its program streams                                     open
no program, or one that is not ours                     closed
======================================================  ============================================

Nothing switches power on, releases brakes or unlocks a protective stop.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from drivers.arrays import Array
from drivers.c4g_packets import DRIVE_ON
from drivers.drive_train import TURN, DriveTrain, MotorSide
from drivers.errors import PacketError, RefusalError
from drivers.events import InitReceived
from drivers.guard import Joints
from drivers.packet_losses import LossTracker
from drivers.states import AxesReport, Input, State
from drivers.ur import outputs
from drivers.ur.arm_state import STATE_DTYPE, state_columns
from drivers.ur.cycles import MAX_GRID_DEVIATION
from drivers.ur.description import START, UrDescription
from drivers.ur.expected import ExpectedArm
from drivers.ur.identity import ArmIdentity
from drivers.ur.outputs import (
    FREEDRIVE_BIT,
    N_JOINTS,
    POWER_MODES,
    ROBOT_MODES,
    ROBOT_RUNNING,
    SAFETY_MODES,
    SAFETY_NORMAL,
)
from drivers.ur.registers import (
    ANGLE_REGISTERS,
    ENDING_REGISTER,
    ENDINGS,
    NUMBER_REGISTER,
    OUTPUTS,
    STAGE_REGISTER,
    TOKEN_REGISTER,
    UNUSED_REGISTER,
    Demand,
    Ending,
    Stage,
)
from drivers.ur.rtde import ControllerVersion, FrameType, OutputRecipe, controller_text
from drivers.ur.script import StreamProgram
from drivers.wire import (
    ArmSettings,
    Handshake,
    MeasuredCycle,
    PacketSort,
    Received,
    Remark,
    Repeated,
    Stale,
)

REQUIRED: Final = (
    "timestamp", "target_q", "target_qd", "target_current", "actual_q", "actual_qd",
    "actual_current", "joint_mode", "robot_mode", "safety_mode", "runtime_state",
    "robot_status_bits", "speed_scaling", "target_speed_fraction", *OUTPUTS,
)  # fmt: skip
"""Outputs without which nothing is moved."""
OPTIONAL: Final = tuple(
    name for name in (*outputs.REQUIRED, *outputs.OPTIONAL) if name not in REQUIRED
)
"""Further outputs, that are recorded where this version has them."""
CB3: Final = 3
"""Major version of the software of CB3 controllers."""
CB3_PERIOD: Final = 0.008
"""Their cycle [s]."""
OLDEST_MINOR: Final = {CB3: 11, 5: 10}
"""Oldest software on which motions run: minor by major version. From 3.11 on a CB3 states its
payload."""
FULL_SPEED_TOLERANCE: Final = 1e-3
"""Largest distance of speed slider and scaling from 1."""
MAX_DEVIATION: Final = 0.8
"""Largest share of the deviation at which the controller stops the arm itself."""
START_TIMEOUT: Final = 5.0
"""Time for the program to run once it was sent, s."""
_RUNTIME_PLAYING: Final = 2
_RUNTIME_STOPPED: Final = 1
_RUNTIME_PAUSING: Final = (3, 4, 5)
_SAFETY_SAFEGUARD: Final = 5
_HEADER_BYTES: Final = 3
_RECIPE_BYTES: Final = 1
_FORMATS: Final = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "INT32": "i", "UINT64": "Q", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip
_COUNTS: Final = {"VECTOR3D": 3, "VECTOR6D": 6, "VECTOR6INT32": 6, "VECTOR6UINT32": 6}
_REPLY: Final = struct.Struct(f">HBBii{N_JOINTS + 1}d")
_NUMBER_MODULUS: Final = 1 << 24
"""Numbers of set-points; with them the sum of a frame is exact to some 1e-9."""
_STAMP_MODULUS: Final = 1 << 30
_REMEMBERED_TARGETS: Final = 64
"""Set-points that are compared with the ones the controller reports as used."""
_TARGET_TOLERANCE: Final = 1e-9
"""Difference of two angles that are one [rad]."""
_REMEDY: Final = (
    "look at the arm and at the pendant; when the arm is ready again, run the same command"
)
_ALL_JOINTS: Final = np.ones(N_JOINTS, dtype=np.bool_)
_NO_JOINTS: Final = np.zeros(N_JOINTS, dtype=np.bool_)


class ArmNotReadyError(RefusalError):
    """The controller is in a state in which no motion may begin, or go on."""

    is_general = False

    def __init__(self, message: str, remedy: str, cycle: int) -> None:
        super().__init__(message, cycle)
        self.remedy = remedy


@dataclass(frozen=True)
class UrProtocol:
    """The protocol of Universal Robots controllers.

    Attributes:
        expected: the arm of the cell.
        program: constants of the program that moves it; the token is that of a session.
    """

    expected: ExpectedArm
    program: StreamProgram

    state = STATE_DTYPE

    def wire(self, settings: ArmSettings) -> UrWire:
        """Return the wire of a session; ValueError for settings that it cannot have."""
        n = settings.drive_train.n_joints
        if n != N_JOINTS:
            raise ValueError(f"{n} joints; an arm of Universal Robots has {N_JOINTS}")
        if settings.only_axis is not None:
            raise ValueError("a controller of Universal Robots opens all axes or none")
        return UrWire(settings, self)

    def own_packets(
        self, drive_train: DriveTrain, position: Array, period: float, limits: tuple[Array, Array]
    ) -> _OwnPackets:
        """See `ControllerProtocol.own_packets`."""
        del limits
        return _OwnPackets(self, drive_train, position, period)


def version_problem(version: ControllerVersion) -> str:
    """Return why no motion runs on this software, or ""."""
    oldest = OLDEST_MINOR.get(version.major)
    if oldest is not None and version.minor >= oldest:
        return ""
    names = {CB3: "a CB3", 5: "PolyScope 5"}
    needed = [f"{major}.{minor} or newer of {names[major]}" for major, minor in _BY_NEWEST]
    return f"motions need {', or '.join(needed)}"


_BY_NEWEST: Final = sorted(OLDEST_MINOR.items(), reverse=True)


def reasons_not_to_move(
    expected: ExpectedArm, description: UrDescription, period: float
) -> tuple[str, ...]:
    """Return why this arm is not moved by this cell, a sentence each."""
    version, identity = description.version, description.identity
    found = [*expected.differences(identity, version.major)]
    if problem := version_problem(version):
        found.append(f"its software is {version}; {problem}")
    if not math.isclose(description.period, period, abs_tol=1e-9):
        ours = f"{1e3 * period:g} ms in the cell"
        found.append(f"cycle is {1e3 * description.period:g} ms in the controller, {ours}")
    if identity.remote_control is False:
        found.append("it is in local mode: switch it to remote control at the pendant")
    return tuple(found)


class _Layout:
    """Where the values of the outputs are in a frame."""

    def __init__(self, recipe: OutputRecipe) -> None:
        self.number = recipe.number
        self.struct = struct.Struct(">" + "".join(_FORMATS[kind] for kind in recipe.types))
        self.length = _HEADER_BYTES + _RECIPE_BYTES + self.struct.size
        at: dict[str, slice] = {}
        offsets: dict[str, int] = {}
        index = 0
        begin = _HEADER_BYTES + _RECIPE_BYTES
        for name, kind in zip(recipe.names, recipe.types, strict=True):
            count = _COUNTS.get(kind, 1)
            at[name] = slice(index, index + count)
            offsets[name] = begin
            index += count
            begin += struct.calcsize(">" + _FORMATS[kind])
        self.at = at
        names = (
            "robot_mode",
            "safety_mode",
            "runtime_state",
            f"output_int_register_{STAGE_REGISTER}",
        )
        self._codes = [slice(offsets[name], offsets[name] + 4) for name in names]
        self._stamp = offsets["timestamp"]
        first = f"output_double_register_{ANGLE_REGISTERS[0]}"
        self.echo = slice(at[first].start, at[first].start + N_JOINTS)

    def sort(self, packet: bytes) -> bytes:
        """Return the codes in a frame that the state depends on."""
        return b"".join(packet[code] for code in self._codes)

    def stamp(self, packet: bytes) -> float:
        """Return the time stamp of a frame [s]."""
        stamp: float = struct.unpack_from(">d", packet, self._stamp)[0]
        return stamp


class UrWire:
    """A session's RTDE: see `drivers.wire.Wire`."""

    reports_use = True
    _broken: bool
    _last_packet: bytes

    def __init__(self, settings: ArmSettings, protocol: UrProtocol) -> None:
        self.description: UrDescription | None = None
        self.motors: MotorSide | None = None
        self.opened: Joints = _ALL_JOINTS
        self._settings = settings
        self._protocol = protocol
        drive_train = settings.drive_train
        self._ratio = drive_train.gear_ratio / TURN
        self._calibration = drive_train.calibration
        self._program = protocol.program
        self._programs = 0
        self._remark = ""
        self._forget_cycles()

    def _forget_cycles(self) -> None:
        self._stamp: float | None = None
        self._cycle = 0
        self._number = 0
        self._steps = 1
        self._ours = False
        self._echo: Array | None = None
        self._unused = self._new_unused = 0
        self._demand = Demand.NOTHING
        self._exits = False
        self._sent_at: int | None = None
        self._upload = b""
        self._sent = np.full((_REMEMBERED_TARGETS, N_JOINTS), np.nan)
        self._target = np.zeros(N_JOINTS)

    def receive(self, packet: bytes, state: State, losses: LossTracker) -> Received:
        """Interpret a packet; see `Wire.receive`."""
        del losses
        if packet[:1] == START:
            return self._introduced(packet, state)
        if len(packet) < _HEADER_BYTES:
            raise PacketError("length", len(packet), "a frame of RTDE")
        if packet[2] == FrameType.TEXT:
            text = controller_text(packet[_HEADER_BYTES:])
            self._remark = text.message
            return Remark(f"{text.source}: {text.message}")
        if packet[2] != FrameType.DATA:
            raise PacketError("type", packet[2], "a frame of outputs, or a text")
        if self.description is None:
            raise PacketError("type", packet[2], "an introduction first")
        return self._cyclic(packet)

    def _introduced(self, packet: bytes, state: State) -> Received:
        if state is State.INIT and packet == self._last_packet:
            return Repeated()
        description = UrDescription.decode(packet)
        missing = [name for name in REQUIRED if name not in description.recipe.names]
        if missing:
            raise PacketError("outputs", missing, "all that a motion needs")
        self.description = description
        self._layout = _Layout(description.recipe)
        joint_sign = self._settings.drive_train.joint_sign
        self._columns = state_columns(description.recipe.dtype, joint_sign)
        self._forget_cycles()
        self._broken = False
        settings = self._settings
        found = reasons_not_to_move(self._protocol.expected, description, settings.period)
        unusable = "; ".join(found) or None
        self.motors = None if unusable else MotorSide(settings.drive_train, settings.period)
        self._last_packet = packet
        return Handshake(Input.INIT, b"", InitReceived(description, unusable, found))

    def _cyclic(self, packet: bytes) -> Received:
        layout = self._layout
        if len(packet) != layout.length:
            raise PacketError("length", len(packet), f"{layout.length} bytes")
        if packet[_HEADER_BYTES] != layout.number:
            raise PacketError(
                "recipe", packet[_HEADER_BYTES], f"{layout.number}, the one requested"
            )
        if packet == self._last_packet:
            return Repeated()
        values = layout.struct.unpack_from(packet, _HEADER_BYTES + _RECIPE_BYTES)
        stamp: float = values[layout.at["timestamp"].start]
        period = self._settings.period
        ahead = 1.0 if self._stamp is None else (stamp - self._stamp) / period
        if self._broken and not ahead >= 1.0 - MAX_GRID_DEVIATION:
            ahead = 1.0  # started again meanwhile
        if not ahead >= 1.0 - MAX_GRID_DEVIATION:
            return Stale(f"the time stamp {stamp:.3f} s does not follow {self._stamp:.3f} s")
        steps = round(ahead) if ahead < _STAMP_MODULUS else 0
        if steps < 1 or abs(ahead - steps) > MAX_GRID_DEVIATION:
            problem = f"{1e3 * period:g} ms, the controller's cycle, or a multiple"
            raise PacketError("time between two frames", f"{1e3 * ahead * period:.3g} ms", problem)
        self._broken = False
        self._stamp = stamp
        self._steps = steps
        self._cycle += steps
        self._number = self._cycle % _NUMBER_MODULUS + 1
        self._values = values
        self._last_packet = packet
        self._report = report = self._read(values)
        return MeasuredCycle(self._number, self._cycle, steps - 1, report)

    def _int(self, name: str) -> int:
        return int(self._values[self._layout.at[name].start])

    def _float(self, name: str, absent: float) -> float:
        at = self._layout.at.get(name)
        return absent if at is None else float(self._values[at.start])

    def _register(self, register: int) -> int:
        return self._int(f"output_int_register_{register}")

    def _read(self, values: tuple[float, ...]) -> AxesReport:
        """Return what a frame says of the axes."""
        layout = self._layout
        playing = self._int("runtime_state") == _RUNTIME_PLAYING
        ours = self._register(TOKEN_REGISTER) == self._program.token
        stage = self._register(STAGE_REGISTER) if ours else Stage.NONE
        self._ours = playing and stage in (Stage.WAITING, Stage.STREAMING, Stage.STOPPING)
        unused = self._register(UNUSED_REGISTER) if self._ours else self._unused
        self._new_unused = max(0, unused - self._unused) if stage == Stage.STREAMING else 0
        self._unused = unused if self._ours else 0
        cause = self._cause(stage)
        kind = self._input(stage)
        opened = kind in (Input.OPEN, Input.PARTLY_OPEN)
        if opened and self._sent_at is not None and stage == Stage.STREAMING:
            self._sent_at = None
        return AxesReport(
            input=kind,
            status=DRIVE_ON if self._int("robot_mode") == ROBOT_RUNNING else 0,
            modes=np.array(values[layout.at["joint_mode"]], dtype=np.int32),
            ready=_ALL_JOINTS if kind is Input.OPEN else _NO_JOINTS,
            held_joints=_ALL_JOINTS if opened else _NO_JOINTS,
            powered=opened,
            any_open=opened,
            unwanted=None,
            cause=cause,
            remedy=_REMEDY,
        )

    def _input(self, stage: int) -> Input:
        robot, safety = self._int("robot_mode"), self._int("safety_mode")
        if robot != ROBOT_RUNNING:
            return Input.DRIVING_ON if robot in POWER_MODES else Input.OFF
        paused = self._int("runtime_state") in _RUNTIME_PAUSING
        if safety == _SAFETY_SAFEGUARD or (paused and safety == SAFETY_NORMAL):
            return Input.PAUSE
        if safety != SAFETY_NORMAL:
            return Input.UNAVAILABLE
        if not self._ours:
            return Input.CLOSED
        if stage == Stage.STOPPING and not self._exits:
            return Input.UNAVAILABLE  # by itself
        return Input.OPEN if stage == Stage.STREAMING else Input.PARTLY_OPEN

    def _cause(self, stage: int) -> str:
        """Return why a motion ends, if one ends with this frame."""
        robot, safety = self._int("robot_mode"), self._int("safety_mode")
        if safety != SAFETY_NORMAL:
            return f"the arm was stopped: {SAFETY_MODES.get(safety, f'safety mode {safety}')}"
        if robot != ROBOT_RUNNING:
            return f"the arm is not running: {ROBOT_MODES.get(robot, f'robot mode {robot}')}"
        if self._int("runtime_state") in _RUNTIME_PAUSING:
            return "the program on the controller was paused"
        if stage in (Stage.STOPPING, Stage.ENDED):
            ending = self._register(ENDING_REGISTER)
            return ENDINGS[Ending(ending) if ending in [*Ending] else Ending.NONE]
        started = stage in (Stage.WAITING, Stage.STREAMING)
        if started and self._int("runtime_state") != _RUNTIME_PLAYING:
            said = f" ({self._remark})" if self._remark else ""
            return ENDINGS[Ending.NONE] + said
        return ""

    def forget(self) -> None:
        """See `Wire.forget`."""
        self.description = self.motors = None

    def lost(self) -> None:
        """See `Wire.lost`."""
        self._broken = True

    def limits(self) -> tuple[Array, Array]:
        """Return no limit of following error, and the current limit of the drive train."""
        drive_train = self._settings.drive_train
        return np.full(N_JOINTS, np.nan), drive_train.current_limit

    def record(self, measured: Array) -> None:
        """See `Wire.record`; the target is the set-point used, else the controller's own target."""
        assert self.motors is not None
        raw, values, layout = self.motors.raw, self._values, self._layout
        at = layout.at
        period = self._settings.period
        ratio, calibration = self._ratio, self._calibration
        if self._ours:
            target = np.array(values[layout.echo])
            before = target if self._echo is None else self._echo
            step = (target - before) / self._steps
            self._echo = target
        else:
            target = np.array(values[at["target_q"]])
            step = period * np.array(values[at["target_qd"]])
            self._echo = None
        self._target = target
        raw[0] = ratio * target + calibration
        raw[1] = ratio * step
        raw[2] = ratio * np.array(values[at["actual_q"]]) + calibration
        raw[3] = (period * ratio) * np.array(values[at["actual_qd"]])
        raw[4] = values[at["actual_current"]]
        raw[5] = values[at["target_current"]]
        raw[6:] = np.nan
        self.motors.to_joints(measured)

    def record_state(self, state: NDArray[np.void]) -> None:
        """See `Wire.record_state`."""
        self._columns.write(self._values, state)

    def fill_safe(self, requested: bool, cycle: int) -> None:
        """Begin a reply that keeps the arm at its last command.

        Raises:
            ArmNotReadyError: the controller's state does not permit a motion.
        """
        kind = self._report.input
        self._reply_target = self._target
        self._demand = Demand.STOP
        if kind is Input.CLOSED:
            self._exits = False
            self._demand = Demand.NOTHING
            if requested:
                self._demand = Demand.STREAM
                self._start(cycle)
            else:
                self._sent_at = None
        elif kind in (Input.OPEN, Input.PARTLY_OPEN):
            self._demand = Demand.STREAM if requested and not self._exits else Demand.END
            if requested:
                self._require_undisturbed(cycle)
            if kind is Input.OPEN:
                self._require_same(cycle)

    def _start(self, cycle: int) -> None:
        """Send the program, once, when the controller is ready for it."""
        playing = self._int("runtime_state") == _RUNTIME_PLAYING
        if (
            self._sent_at is None
            and playing
            and self._register(TOKEN_REGISTER) == self._program.token
        ):
            return  # the program of the motion before is about to end
        if self._sent_at is None:
            self._require_startable(cycle)
            self._programs += 1
            stamp = self._stamp or 0.0
            token = (round(1e3 * stamp) * 16 + self._programs) % _STAMP_MODULUS + 1
            self._program = replace(self._program, token=token)
            self._upload = self._program.text().encode()
            self._sent_at = cycle
            self._remark = ""
        elif cycle - self._sent_at > START_TIMEOUT / self._settings.period:
            self._sent_at = None
            said = f": {self._remark}" if self._remark else ""
            problem = f"the program did not run within {START_TIMEOUT:g} s{said}"
            remedy = (
                "check that the controller is in remote control, and its primary interface enabled"
            )
            raise ArmNotReadyError(problem, remedy, cycle)

    def _require_startable(self, cycle: int) -> None:
        if self._int("runtime_state") != _RUNTIME_STOPPED:
            remedy = "stop it at the pendant, or wait for its end"
            raise ArmNotReadyError("another program runs on the controller", remedy, cycle)
        self._require_undisturbed(cycle)
        mass = self._float("payload", np.nan)
        at = self._layout.at.get("payload_cog")
        centre = (np.nan,) * 3 if at is None else tuple(self._values[at])
        difference = self._protocol.expected.payload_difference(mass, centre)
        if difference:
            remedy = "set the payload at the controller, or correct the cell file"
            raise ArmNotReadyError(difference, remedy, cycle)

    def _require_undisturbed(self, cycle: int) -> None:
        """Require full speed, and no freedrive."""
        if self._int("robot_status_bits") >> FREEDRIVE_BIT & 1:
            remedy = "release the freedrive button"
            raise ArmNotReadyError("a person moves the arm by hand (freedrive)", remedy, cycle)
        slider = self._float("target_speed_fraction", 1.0)
        if not abs(slider - 1.0) <= FULL_SPEED_TOLERANCE:
            remedy = "set it to 100 %: set-points are sent at full rate, whatever it is"
            raise ArmNotReadyError(f"the speed slider is at {100.0 * slider:.3g} %", remedy, cycle)
        if not self._ours:
            return
        scaling = self._float("speed_scaling", 1.0)
        if not abs(scaling - 1.0) <= FULL_SPEED_TOLERANCE:
            remedy = "look at the pendant for the limit that slows the arm down"
            problem = f"the controller slows the arm down to {100.0 * scaling:.3g} %"
            raise ArmNotReadyError(problem, remedy, cycle)
        deviation = self._float("joint_position_deviation_ratio", 0.0)
        if not deviation <= MAX_DEVIATION:
            remedy = "check payload and obstacles, then go slower"
            problem = f"the arm is at {100.0 * deviation:.3g} % of the deviation that stops it"
            raise ArmNotReadyError(problem, remedy, cycle)

    def _require_same(self, cycle: int) -> None:
        """Require that a set-point that was used is the one that was sent under its number."""
        number = self._register(NUMBER_REGISTER)
        if self._new_unused or (self._number - number) % _NUMBER_MODULUS >= _REMEMBERED_TARGETS:
            return
        sent = self._sent[number % _REMEMBERED_TARGETS]
        if (
            not (np.abs(sent - self._target) <= _TARGET_TOLERANCE).all()
            and not np.isnan(sent).all()
        ):
            remedy = "have another look at who writes the registers of the controller"
            problem = f"the controller used another set-point than number {number} that was sent"
            raise ArmNotReadyError(problem, remedy, cycle)

    def fill_refusal(self, offending: int | None) -> None:
        """Ask the program to stop the arm and to end."""
        del offending
        self._reply_target = self._target
        self._demand = Demand.STOP

    def require_targets(self, cycle: int) -> None:
        """Require that the set-point to be repeated is finite."""
        if self._report.any_open and not np.isfinite(self._target).all():
            raise RefusalError("the set-point that the controller used is not finite", cycle)

    def require_other_targets(self, cycle: int) -> None:
        """Do nothing: there are no other axes."""
        del cycle

    def not_used(self) -> int:
        """Return the cycles without a new set-point, as the program counts them."""
        return self._new_unused

    def write(self, position: Array, step: Array) -> None:
        """Send the set-point."""
        del step
        self._reply_target = (position - self._calibration) / self._ratio

    def write_rest(self, position: Array, where: Joints) -> None:
        """Send the set-point; joints not in `where` stay at their target."""
        angles = (position - self._calibration) / self._ratio
        self._reply_target = np.where(where, angles, self._target)

    def request_exit(self) -> None:
        """See `Wire.request_exit`; the demand stays until the program has ended."""
        self._exits = True
        self._demand = Demand.END

    def finish(self) -> bytes:
        """Return the frame of inputs, and behind it the program if it is to be started."""
        assert self.description is not None
        number, q = self._number, self._reply_target
        self._sent[number % _REMEMBERED_TARGETS] = q
        values = q.tolist()
        check = sum(values) + number
        upload, self._upload = self._upload, b""
        frame = _REPLY.pack(
            _REPLY.size,
            FrameType.DATA,
            self.description.inputs,
            number,
            self._demand,
            *values,
            check,
        )
        return frame + upload

    def sort(self, packet: bytes) -> PacketSort:
        """Return the codes on which the state depends; any other packet differs from all others."""
        starts = packet[:1] == START
        if self.description is None or len(packet) != self._layout.length or starts:
            return PacketSort(starts, packet, 0)
        stamp = self._layout.stamp(packet)
        number = round(stamp / self._settings.period) if np.isfinite(stamp) else 0
        return PacketSort(False, self._layout.sort(packet), number)

    def ahead(self, later: int, earlier: int) -> int:
        """Return the cycles between two time stamps, modulo the range of numbers."""
        return (later - earlier) % _STAMP_MODULUS


class _OwnPackets:
    """Frames of an arm at rest whose program streams."""

    def __init__(
        self, protocol: UrProtocol, drive_train: DriveTrain, position: Array, period: float
    ) -> None:
        names = (*REQUIRED, *OPTIONAL)
        types = tuple(_TYPES.get(name) or _register_type(name) for name in names)
        expected = protocol.expected
        identity = ArmIdentity(
            serial_number=expected.serial_number or None,
            model=expected.model or None,
            calibration=expected.calibration or None,
        )
        recipe = OutputRecipe(1, names, types)
        major = CB3 if abs(period - CB3_PERIOD) < 1e-9 else max(OLDEST_MINOR)
        version = ControllerVersion(major, OLDEST_MINOR[major], 0, 0)
        self._description = UrDescription(identity, version, 1.0 / period, recipe, 1)
        self._layout = _Layout(self._description.recipe)
        angles = drive_train.joint_sign * position + drive_train.joint_offset
        self._rest: dict[str, float | list[float]] = {
            "target_q": angles.tolist(), "actual_q": angles.tolist(), "robot_mode": ROBOT_RUNNING,
            "safety_mode": SAFETY_NORMAL, "speed_scaling": 1.0, "target_speed_fraction": 1.0,
            "payload": expected.payload, "payload_cog": list(expected.centre or (0.0, 0.0, 0.0)),
            **{f"output_double_register_{ANGLE_REGISTERS[j]}": angles[j] for j in range(N_JOINTS)},
        }  # fmt: skip
        self._cycle = 0
        self._period = period

    def first(self) -> bytes:
        return self._description.encode()

    def next(self, *, opened: bool) -> bytes:
        self._cycle += 1
        stamp = self._cycle * self._period
        # The session sends its program with the first frame, by whose stamp it is numbered.
        token = (round(1e3 * self._period) * 16 + 1) % _STAMP_MODULUS + 1
        values = {
            **self._rest,
            "timestamp": stamp,
            "runtime_state": _RUNTIME_PLAYING if opened else _RUNTIME_STOPPED,
            f"output_int_register_{TOKEN_REGISTER}": token,
            f"output_int_register_{STAGE_REGISTER}": Stage.STREAMING if opened else Stage.NONE,
            f"output_int_register_{NUMBER_REGISTER}": self._cycle,
        }
        flat: list[float] = []
        recipe = self._description.recipe
        for name, kind in zip(recipe.names, recipe.types, strict=True):
            value = values.get(name, 0)
            flat += value if isinstance(value, list) else [value] * _COUNTS.get(kind, 1)
        payload = self._layout.struct.pack(*flat)
        header = struct.pack(">HBB", self._layout.length, FrameType.DATA, recipe.number)
        return header + payload


_TYPES: Final = {
    "timestamp": "DOUBLE", "speed_scaling": "DOUBLE", "target_speed_fraction": "DOUBLE",
    "payload": "DOUBLE", "joint_position_deviation_ratio": "DOUBLE", "payload_cog": "VECTOR3D",
    "collision_detection_ratio": "DOUBLE", "safety_status_bits": "UINT32",
    "joint_mode": "VECTOR6INT32", "robot_mode": "INT32", "safety_mode": "INT32",
    "runtime_state": "UINT32", "robot_status_bits": "UINT32",
    **dict.fromkeys(
        (
            "target_q", "target_qd", "target_qdd", "target_current", "target_moment", "actual_q",
            "actual_qd", "actual_current", "joint_temperatures", "joint_control_output",
            "payload_inertia", "actual_current_as_torque",
        ),
        "VECTOR6D",
    ),
}  # fmt: skip


def _register_type(name: str) -> str:
    return "INT32" if "_int_" in name else "DOUBLE"
