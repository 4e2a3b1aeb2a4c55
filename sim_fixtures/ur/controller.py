"""The controller of a simulated UR5e: its program, its modes, and the outputs of every cycle."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple, cast, get_args

import numpy as np

from sim_fixtures.arm import UnmodelledEffects
from sim_fixtures.arrays import Array
from sim_fixtures.plant import Carried
from sim_fixtures.settings import SettingError
from sim_fixtures.ur.arm import UR5E_URDF, SimulatedUrArm, UrArmTruth
from sim_fixtures.ur.control_script import FIRST_LINE, ControlScript
from sim_fixtures.ur.program import (
    ENDED,
    STOPPING,
    ProgramConstants,
    ProgramError,
    RegisterProgram,
    Registers,
)

RUNNING: Final = 7
POWER_OFF: Final = 3
_JOINT_RUNNING: Final = 253
_JOINT_OFF: Final = 239
_STOPPED: Final = 1
_PLAYING: Final = 2
_PAUSED: Final = 4
_NORMAL: Final = 1
_PROTECTIVE_STOP: Final = 3
_FLANGE_JOINT: Final = 5  # joint that carries the payload, from 0
_STOPPING_SECONDS: Final = 0.2  # s within which a protective stop ends the motion
_SAFEGUARD_STOP: Final = 5
_EMERGENCY_STOP: Final = 7
_SAFETY_BITS: Final = {_NORMAL: 1, _PROTECTIVE_STOP: 1 << 2, _SAFEGUARD_STOP: 1 << 4,
                       _EMERGENCY_STOP: 1 << 7}  # fmt: skip
_SAFETY_NAMES: Final = {_NORMAL: "NORMAL", _PROTECTIVE_STOP: "PROTECTIVE_STOP",
                        _SAFEGUARD_STOP: "SAFEGUARD_STOP",
                        _EMERGENCY_STOP: "ROBOT_EMERGENCY_STOP"}  # fmt: skip
_LOADING_CYCLES: Final = 10  # cycles until a program that was sent begins
_STOP_DECELERATION: Final = 15.0  # of stops by the controller, rad/s²
_MAX_DEVIATION: Final = 0.1  # rad between arm and target
_MAX_SERVO_SPEED: Final = 12.0  # rad/s of a set-point of servoj above which it is a jump
_REST_SPEED: Final = 1e-6  # rad/s
_STEADY_SECONDS: Final = 0.5  # s at rest after which is_steady() is true
_FLANGE_OFFSET: Final = 0.0996  # m from the last joint's frame to the flange, along its axis


@dataclass(frozen=True, eq=False)
class UrProgram:
    """Motion of the controller's own program: rest, then sines about a posture, then rest.

    Attributes:
        centre: posture (6,) [rad].
        amplitude: of each sine (6, k) [rad].
        period: of the slowest sine [s].
        rest: s at the centre before and after the motion; also the whole, without `periods`.
        periods: number of periods.
    """

    centre: Array = field(default_factory=lambda: np.radians([0.0, -80.0, 95.0, -100.0, -85.0, 5]))
    amplitude: Array = field(
        default_factory=lambda: np.array(
            [
                [0.55, 0.18, -0.12, 0.06],
                [0.35, -0.2, 0.1, 0.05],
                [-0.4, 0.24, 0.12, -0.06],
                [0.6, 0.25, -0.2, 0.08],
                [-0.55, 0.3, 0.18, 0.09],
                [0.8, -0.35, 0.25, 0.1],
            ]
        )
    )
    period: float = 12.0
    rest: float = 2.0
    periods: int = 1

    def target(self, time: float) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration (6,) at a time of the program [s]."""
        ramp, moving = 0.1 * self.period, time - self.rest
        whole = self.period * self.periods
        if not 0.0 < moving < whole:
            return self.centre, np.zeros(6), np.zeros(6)
        order = np.arange(1, self.amplitude.shape[1] + 1)
        rate = 2.0 * np.pi / self.period * order
        sine, cosine = np.sin(rate * moving), np.cos(rate * moving)
        q = self.amplitude @ sine
        qd = self.amplitude @ (rate * cosine)
        qdd = -self.amplitude @ (rate**2 * sine)
        # The motion fades in and out, so that it begins and ends at rest.
        end = whole - moving
        s, sd, sdd = _fade(min(moving, end) / ramp)
        sd, sdd = (sd if moving < end else -sd) / ramp, sdd / ramp**2
        return (
            self.centre + s * q,
            s * qd + sd * q,
            s * qdd + 2.0 * sd * qd + sdd * q,
        )

    @property
    def duration(self) -> float:
        """Time of the whole program [s]."""
        return self.period * self.periods + 2.0 * self.rest


def _fade(x: float) -> tuple[float, float, float]:
    """Return a polynomial from 0 to 1 and its derivatives, at rest at both ends."""
    if x >= 1.0:
        return 1.0, 0.0, 0.0
    return (
        x**3 * (10.0 - 15.0 * x + 6.0 * x**2),
        30.0 * x**2 * (1.0 - x) ** 2,
        60.0 * x * (1.0 - 3.0 * x + 2.0 * x**2),
    )


UrFaultKind = Literal[
    "gap", "batch", "text", "restart", "disconnect", "truncate", "silence", "stop", "power-off",
    "emergency-stop", "safeguard", "pause", "resume", "halt", "freedrive", "slider", "push",
]  # fmt: skip


@dataclass(frozen=True)
class UrFault:
    """A fault of the controller or of its connections.

    Kinds are "gap" (`count` frames are not sent), "batch" (they are sent together), "text" (a line
    of text in between), "restart" (the controller's time begins again), "disconnect", "truncate"
    (disconnected within a frame), "silence" (nothing is sent any more), "stop" (a protective stop),
    "power-off", "emergency-stop" and "safeguard". An operator does "pause", "resume" (also after a
    protective stop, which is unlocked by that) and "halt" (the program is stopped), holds the
    "freedrive" button for `count` cycles, sets the "slider" to `count` percent, and "push" puts
    `count` thousandths of a radian between arm and target.
    """

    kind: UrFaultKind
    cycle: int
    count: int = 1


_FAULT: Final = re.compile(r"(?P<kind>[a-z-]+)@(?P<cycle>[0-9]{1,9})(?:x(?P<count>[0-9]{1,9}))?")


def parse_ur_fault(text: str) -> UrFault:
    """Return the fault that KIND@CYCLE or KIND@CYCLExCOUNT means.

    Raises:
        SettingError: it is none; the kinds are named.
    """
    match = _FAULT.fullmatch(text)
    kinds = get_args(UrFaultKind)
    if match is None or match["kind"] not in kinds:
        raise SettingError("fault", text, f"KIND@CYCLE[xCOUNT]; kinds are {', '.join(kinds)}")
    kind = cast(UrFaultKind, match["kind"])
    return UrFault(kind, int(match["cycle"]), int(match["count"] or 1))


class Said(NamedTuple):
    """What a controller says on its primary interface; with the code of an error, or of a program.

    Attributes:
        words: its text.
        code, argument: as in C204A1; 0 for an error of the program.
    """

    words: str
    code: int = 0
    argument: int = 0


@dataclass(frozen=True)
class UrPayload:
    """Payload as entered at the controller, in the frame of the flange."""

    mass: float = 0.0  # kg
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m


@dataclass(frozen=True)
class UrSettings:
    """What a simulated controller states of itself, and how it behaves.

    Attributes:
        version: of its software; 5 for e-Series.
        serial_number, model, remote_control: as on its dashboard.
        kind: number of its type.
        slider: speed slider, 0 to 1.
        payload: as entered; what the flange carries in truth is the arm's.
        first_time: time stamp of the first cycle [s].
        input_delay: cycles by which inputs are used later than in the next one.
        without: outputs that its version does not have.
        inputs_in_use: inputs that a field bus writes.
    """

    version: tuple[int, int, int, int] = (5, 15, 2, 0)
    serial_number: str = "20235500123"
    model: str = "UR5"
    remote_control: bool = False
    kind: int = 1
    slider: float = 1.0
    payload: UrPayload = field(default_factory=UrPayload)
    first_time: float = 812.414
    input_delay: int = 1
    without: Sequence[str] = ("actual_current_as_torque",)
    inputs_in_use: Sequence[str] = ()

    @property
    def frequency(self) -> float:
        """Cycles per second."""
        return 125.0 if self.version[0] <= 3 else 500.0


class SimulatedUr:
    """Controller and arm in virtual time: `step` is one cycle.

    Args:
        settings: what it states.
        program: its own motion; None for rest.
        truth: what the arm is.
        faults: by cycle, from 0.
        seed: of the noise.
        load: what the flange carries beyond the payload entered.
        repeats: whether the program begins again at its end.
        at: where it rests without a program (6,) [rad].
        urdf: of the arm; the primary interface always states the kinematics of a UR5e.
        effects: that a model of the arm leaves out.
    """

    def __init__(
        self,
        settings: UrSettings | None = None,
        program: UrProgram | None = None,
        *,
        truth: UrArmTruth | None = None,
        faults: Sequence[UrFault] = (),
        seed: int = 0,
        load: Carried | None = None,
        repeats: bool = False,
        urdf: str = UR5E_URDF,
        at: Array | None = None,
        effects: UnmodelledEffects | None = None,
    ) -> None:
        self.settings = settings or UrSettings()
        self.period = 1.0 / self.settings.frequency
        self._program = program
        rest = UrProgram() if at is None else UrProgram(centre=at)
        self._motion = rest if program is None else program
        self._repeats = repeats
        self.faults = tuple(faults)
        self.arm = SimulatedUrArm(
            truth or UrArmTruth(),
            self._motion.centre,
            self.period,
            seed=seed,
            load=load,
            entered=_carried(self.settings.payload),
            urdf=urdf,
            effects=effects,
        )
        self.cycle = -1
        self._program_time = 0.0
        self._offset = 0
        self._stopped_for: float | None = None
        self._power = True
        self._safety = _NORMAL
        self._paused = False
        self._freedrive_until = -1
        self.slider = self.settings.slider
        self.inputs = Registers()
        self.output_registers = Registers()
        self.stream: RegisterProgram | ControlScript | None = None
        self.said: list[Said] = []
        self._arriving: deque[tuple[int, Mapping[str, float]]] = deque()
        # None for the script of ur-rtde, whose constants come with each command.
        self._loaded: tuple[int, ProgramConstants | None] | None = None
        self._written_at = 0
        self._moved_at = -round(_STEADY_SECONDS / self.period)
        self._commanded: Array | None = None  # by servoj in the last cycle
        self._rest: Array | None = None  # where a program left the arm
        self._target = self._motion.target(0.0)

    @property
    def time(self) -> float:
        """Time since the start of the controller [s]."""
        return self.settings.first_time + (self.cycle - self._offset) * self.period

    @property
    def finished(self) -> bool:
        """Whether the program has ended."""
        return (
            self._program is not None
            and not self._repeats
            and self._program_time >= self._program.duration
        )

    def write_inputs(self, values: Mapping[str, float]) -> None:
        """Receive a frame of inputs: registers by their names."""
        self._arriving.append((self.cycle + 1 + self.settings.input_delay, values))

    def upload(self, text: str) -> None:
        """Receive a program: it stops the one that runs, and begins a little later.

        What the controller says to it is in `said`.
        """
        if not self.settings.remote_control:
            self.said.append(Said("program refused: the controller is in local mode"))
        elif not self._power or self._safety != _NORMAL:
            self.said.append(Said("program refused: the arm is not ready"))
        else:
            try:
                ours = not text.lstrip().startswith(FIRST_LINE)
                constants = ProgramConstants.of(text) if ours else None
            except ProgramError as error:
                self.said.append(Said(str(error)))
                return
            self._leave_program()
            self._loaded = (self.cycle + _LOADING_CYCLES, constants)

    def _leave_program(self) -> None:
        """Forget the program that ran; the arm stays where its target is."""
        self._rest = self._target[0].copy()
        self.stream = None
        self._program = None
        self._commanded = None
        self._paused = False

    def step(self) -> None:
        """Run one cycle."""
        self.cycle += 1
        while self._arriving and self._arriving[0][0] <= self.cycle:
            _, values = self._arriving.popleft()
            self.inputs.write(values)
            self._written_at = self.cycle
        for fault in self.faults:
            if fault.cycle == self.cycle:
                self._apply(fault)
        if not self._power:
            self.arm.rest()
            return
        if self._loaded is not None and self.cycle >= self._loaded[0]:
            constants = self._loaded[1]
            self._loaded = None
            position = self._target[0]
            registers = self.inputs, self.output_registers
            self.stream = (
                ControlScript(*registers, position, self.period)
                if constants is None
                else RegisterProgram(constants, *registers, position)
            )
            self._written_at = self.cycle
        if self.stream is not None or self._rest is not None:
            self._step_stream()
            self.arm.step(*self._target)
            return
        scaling = self.speed_scaling
        self._program_time += scaling * self.period
        time = self._program_time
        if self._repeats and self._program is not None:
            time %= self._program.duration
        q, qd, qdd = self._motion.target(time if self._program is not None else 0.0)
        decelerating = (
            0.0 if self._stopped_for is None or scaling == 0.0 else -1.0 / _STOPPING_SECONDS
        )
        self._target = q, scaling * qd, scaling**2 * qdd + decelerating * qd
        self.arm.step(*self._target)

    def _step_stream(self) -> None:
        """Move the target as servoj, a stop of the program, or rest have it."""
        program = self.stream
        if np.any(np.abs(self._target[1]) > _REST_SPEED):
            self._moved_at = self.cycle
        if program is not None and program.stage == ENDED:
            self._leave_program()
            program = None
        if program is not None and self._safety == _NORMAL and not self._paused:
            if program.stage != STOPPING:
                self._run_program(program)
            else:
                self._brake(program.constants.deceleration)
                if not self._target[1].any():
                    program.end()
            return
        self._brake(_STOP_DECELERATION)

    def _run_program(self, program: RegisterProgram | ControlScript) -> None:
        """Run a cycle of the program, and of the filter of servoj behind it."""
        constants = program.constants
        silent = (self.cycle - self._written_at) * self.period
        if program.watched and silent > constants.watchdog:
            self.said.append(Said("the watchdog of RTDE stopped the program"))
            self._leave_program()
            self._brake(_STOP_DECELERATION)
            return
        program.step(self.arm.plant.position, lambda: self._is_steady)
        if program.stage == STOPPING:
            self._brake(constants.deceleration)
            return
        command = program.command
        before = command if self._commanded is None else self._commanded
        self._commanded = command.copy()
        if (np.abs(command - before) > _MAX_SERVO_SPEED * self.period).any():
            self._protect(Said("sudden change in target position", 204, 1))
            return
        q, qd, _ = self._target
        rate = 2.0 / constants.lookahead
        decay = np.exp(-rate * self.period)
        off = q - command
        slope = qd + rate * off
        new = command + (off + slope * self.period) * decay
        new_speed = (qd - rate * slope * self.period) * decay
        self._target = new, new_speed, (new_speed - qd) / self.period
        if self.deviation_ratio >= 1.0:
            self._protect(Said("position deviates from path", 153, 1))

    def _brake(self, deceleration: float) -> None:
        """Slow the target down, the fastest joint by so much [rad/s²]."""
        q, qd, _ = self._target
        fastest = float(np.abs(qd).max())
        less = deceleration * self.period
        new = qd * (1.0 - less / fastest) if fastest > less else np.zeros(6)
        self._target = q + 0.5 * self.period * (qd + new), new, (new - qd) / self.period

    def _protect(self, error: Said) -> None:
        """Stop the arm, and pause the program, until an operator unlocks it."""
        self.said.append(error)
        self._safety = _PROTECTIVE_STOP
        self._paused = True

    @property
    def _is_steady(self) -> bool:
        return (self.cycle - self._moved_at) * self.period >= _STEADY_SECONDS

    @property
    def deviation_ratio(self) -> float:
        """Distance of the arm from its target, of the largest that is allowed."""
        return float(np.abs(self._target[0] - self.arm.plant.position).max() / _MAX_DEVIATION)

    @property
    def speed_scaling(self) -> float:
        """Speed of the program as a fraction of its own, by the slider and by a stop."""
        if self._stopped_for is None:
            return self.slider
        remaining = 1.0 - (self.cycle * self.period - self._stopped_for) / _STOPPING_SECONDS
        return self.slider * max(0.0, remaining)

    def _apply(self, fault: UrFault) -> None:
        match fault.kind:
            case "restart":
                self._offset = self.cycle
            case "stop":
                self._stopped_for = self.cycle * self.period
                self._protect(Said("collision detected", 157, 1))
            case "power-off":
                self._power = False
                self._leave_program()
            case "emergency-stop":
                self._safety = _EMERGENCY_STOP
                self._power = False
                self._leave_program()
            case "safeguard":
                self._safety = _SAFEGUARD_STOP
                self._paused = True
            case "pause":
                self._paused = True
            case "resume":
                self._safety = _NORMAL
                self._paused = False
                self._stopped_for = None
            case "halt":
                self._leave_program()
            case "freedrive":
                self._freedrive_until = self.cycle + fault.count
            case "slider":
                self.slider = fault.count / 100.0
            case "push":
                plant = self.arm.plant
                plant.set_state(plant.position + 1e-3 * fault.count, plant.velocity)

    def make_ready(self) -> None:
        """Do what an operator does after a stop: power, unlocking, full speed, no program."""
        self._power = True
        self._safety = _NORMAL
        self._stopped_for = None
        self._freedrive_until = -1
        self.slider = 1.0
        self._leave_program()

    @property
    def takes_set_points(self) -> bool:
        """Whether a program runs that needs one in each cycle."""
        return isinstance(self.stream, RegisterProgram)

    @property
    def playing(self) -> bool:
        """Whether a program runs."""
        own = self._program is not None and not self.finished
        running = self._power and self._safety == _NORMAL and not self._paused
        return running and (own or self.stream is not None)

    @property
    def robot_mode_name(self) -> str:
        """The robot mode as the dashboard states it."""
        return "RUNNING" if self._power else "POWER_OFF"

    @property
    def safety_name(self) -> str:
        """The safety status as the dashboard states it."""
        return _SAFETY_NAMES[self._safety]

    def outputs(self) -> Mapping[str, float | int | Array]:
        """Return the outputs of the present cycle by name."""
        arm = self.arm
        q, qd, qdd = self._target
        running = self._power
        own = self._program is not None and not self.finished
        loaded = running and (own or self.stream is not None)
        playing = self.playing
        freedrive = self.cycle < self._freedrive_until
        position = arm.measured_position()
        payload = self.settings.payload
        zeros = np.zeros(6)
        outputs: dict[str, float | int | Array] = {
            "timestamp": self.time,
            "target_q": q, "target_qd": qd, "target_qdd": qdd,
            "target_current": arm.target_current, "target_moment": arm.target_moment,
            "actual_q": position,
            "actual_qd": arm.measured_velocity(),
            "actual_current": arm.measured_current() if running else zeros,
            "actual_current_window": np.full(6, 2.0),
            "joint_control_output": arm.current,
            "joint_temperatures": arm.temperature,
            "joint_mode": np.full(6, _JOINT_RUNNING if running else _JOINT_OFF),
            "robot_mode": RUNNING if running else POWER_OFF,
            "safety_mode": self._safety,
            "safety_status": self._safety,
            "speed_scaling": self.speed_scaling if running else 0.0,
            "target_speed_fraction": self.slider,
            "runtime_state": _PLAYING if playing else _PAUSED if loaded else _STOPPED,
            "robot_status_bits": int(running) | int(playing) << 1 | int(freedrive) << 2,
            "safety_status_bits": _SAFETY_BITS.get(self._safety, 1),
            "payload": payload.mass,
            "payload_cog": np.array(payload.centre),
            "payload_inertia": zeros,
            "joint_position_deviation_ratio": self.deviation_ratio,
            "collision_detection_ratio": 0.0,
            "actual_current_as_torque": arm.truth.stated_constant * arm.current,
            **{f"output_int_register_{k}": v for k, v in self.output_registers.ints.items()},
            **{f"output_double_register_{k}": v for k, v in self.output_registers.floats.items()},
        }  # fmt: skip
        for name in self.settings.without:
            del outputs[name]
        return outputs


def _carried(payload: UrPayload) -> Carried | None:
    if payload.mass == 0.0:
        return None
    x, y, z = payload.centre
    centre = np.array([x, y, z + _FLANGE_OFFSET])
    return Carried(_FLANGE_JOINT, payload.mass, centre, np.zeros((3, 3)))
