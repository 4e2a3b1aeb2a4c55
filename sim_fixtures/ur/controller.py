"""The controller of a simulated UR5e: its program, its modes, and the outputs of every cycle."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal, cast, get_args

import numpy as np

from sim_fixtures.arrays import Array
from sim_fixtures.plant import Carried
from sim_fixtures.settings import SettingError
from sim_fixtures.ur.arm import UR5E_URDF, SimulatedUrArm, UrArmTruth

RUNNING: Final = 7
POWER_OFF: Final = 3
_JOINT_RUNNING: Final = 253
_JOINT_OFF: Final = 239
_STOPPED: Final = 1
_PLAYING: Final = 2
_PAUSED: Final = 4
_NORMAL: Final = 1
_PROTECTIVE_STOP: Final = 3
_FLANGE: Final = 5  # joint that carries the payload, from 0
_STOPPING: Final = 0.2  # s within which a protective stop ends the motion
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
    "gap", "batch", "text", "restart", "disconnect", "truncate", "silence", "stop", "power-off"
]


@dataclass(frozen=True)
class UrFault:
    """A fault of the controller or of its connections.

    Kinds are "gap" (`count` frames are not sent), "batch" (they are sent together), "text" (a line
    of text in between), "restart" (the controller's time begins again), "disconnect", "truncate"
    (disconnected within a frame), "silence" (nothing is sent any more), "stop" (a protective stop)
    and "power-off".
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
        without: outputs that its version does not have.
    """

    version: tuple[int, int, int, int] = (5, 15, 2, 0)
    serial_number: str = "20235500123"
    model: str = "UR5"
    remote_control: bool = False
    kind: int = 1
    slider: float = 1.0
    payload: UrPayload = field(default_factory=UrPayload)
    first_time: float = 812.414
    without: Sequence[str] = ("actual_current_as_torque",)

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
        urdf: of the arm; its kinematics as the primary interface states them are those of a UR5e.
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
    ) -> None:
        self.settings = settings or UrSettings()
        self.period = 1.0 / self.settings.frequency
        self._program = program
        self._motion = UrProgram() if program is None else program
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
        )
        self.cycle = -1
        self._program_time = 0.0
        self._offset = 0
        self._stopped_for: float | None = None
        self._power = True
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

    def step(self) -> None:
        """Run one cycle."""
        self.cycle += 1
        for fault in self.faults:
            if fault.cycle == self.cycle:
                self._apply(fault)
        if not self._power:
            self.arm.rest()
            return
        scaling = self.speed_scaling
        self._program_time += scaling * self.period
        time = self._program_time
        if self._repeats and self._program is not None:
            time %= self._program.duration
        q, qd, qdd = self._motion.target(time if self._program is not None else 0.0)
        decelerating = 0.0 if self._stopped_for is None or scaling == 0.0 else -1.0 / _STOPPING
        self._target = q, scaling * qd, scaling**2 * qdd + decelerating * qd
        self.arm.step(*self._target)

    @property
    def speed_scaling(self) -> float:
        """Speed of the program as a fraction of its own, by the slider and by a stop."""
        if self._stopped_for is None:
            return self.settings.slider
        remaining = 1.0 - (self.cycle * self.period - self._stopped_for) / _STOPPING
        return self.settings.slider * max(0.0, remaining)

    def _apply(self, fault: UrFault) -> None:
        match fault.kind:
            case "restart":
                self._offset = self.cycle
            case "stop":
                self._stopped_for = self.cycle * self.period
            case "power-off":
                self._power = False

    def outputs(self) -> Mapping[str, float | int | Array]:
        """Return the outputs of the present cycle by name."""
        arm = self.arm
        q, qd, qdd = self._target
        running = self._power
        stopped = self._stopped_for is not None
        playing = running and not stopped and self._program is not None and not self.finished
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
            "safety_mode": _PROTECTIVE_STOP if stopped else _NORMAL,
            "safety_status": _PROTECTIVE_STOP if stopped else _NORMAL,
            "speed_scaling": self.speed_scaling if running else 0.0,
            "target_speed_fraction": self.settings.slider,
            "runtime_state": _PAUSED if stopped else _PLAYING if playing else _STOPPED,
            "robot_status_bits": int(running) | int(playing) << 1,
            "safety_status_bits": 1 << 2 if stopped else 1,
            "payload": payload.mass,
            "payload_cog": np.array(payload.centre),
            "payload_inertia": zeros,
            "joint_position_deviation_ratio": float(np.abs(q - position).max() / 0.1),
            "collision_detection_ratio": 0.0,
            "actual_current_as_torque": arm.truth.stated_constant * arm.current,
        }  # fmt: skip
        for name in self.settings.without:
            del outputs[name]
        return outputs


def _carried(payload: UrPayload) -> Carried | None:
    if payload.mass == 0.0:
        return None
    x, y, z = payload.centre
    centre = np.array([x, y, z + _FLANGE_OFFSET])
    return Carried(_FLANGE, payload.mass, centre, np.zeros((3, 3)))
