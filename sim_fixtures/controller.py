"""The controller's end of the link, with its servo and the arm behind it, in virtual time.

`SimulatedController` is what a transport in virtual time talks to: `next_packet()` gives the packet
of a cycle, `accept(reply)` takes the PC's answer and lets one period pass. It has no clock, thread
or file; one seed gives one run, bit for bit.

Time line of cycle k, which begins at t_k with T the period:

    t_k             encoders are read; packet k carries them as D3, and as D5 the target current
                    that the servo computed at t_(k-1) from the positions of packet k-1
    right after     the reply brings the target for t_(k+1); the servo computes its current
    t_k .. t_(k+1)  the plant moves under that current, which flows with a lag of tau

The current in packet k acted from t_(k-1) to t_k, in the mean at t_k - T/2 + tau. So position and
current of one packet are `current_delay_cycles` = 1/2 - tau/T cycles apart: the current that
belongs to the position of packet k stands that many cycles *later* in the recording.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.errors import PacketError
from drivers.packets import (
    AXIS_DTYPE,
    DRIVE_ON,
    EXIT_FROM_OPEN,
    MAX_AXES,
    N_ARMS,
    CyclicPacket,
    InitPacket,
    Mode,
    next_number,
    packet_number,
)
from sim_fixtures.arm import SimulatedArm
from sim_fixtures.drive import SimulatedDrive
from sim_fixtures.effects import UnmodelledEffects
from sim_fixtures.errors import SettingError
from sim_fixtures.nominal_model import NominalModel
from sim_fixtures.plant import Plant
from sim_fixtures.program import MISSING, Answer, LoopProgram, Phase, StartStep
from sim_fixtures.servo import Servo
from sim_fixtures.settings import ControllerSettings
from sim_fixtures.truth import PlantTruth, standard_parameters

Array = NDArray[np.float64]

EARTH = (0.0, 0.0, -9.81)
NO_EFFECTS = UnmodelledEffects()

_ON = bytes((DRIVE_ON, 0, 0, 0))
_OFF = bytes(N_ARMS)
_COMMON_MODE = {Phase.DRIVING_ON: Mode.DRIVING_ON, Phase.ENDING: Mode.END_OF_SESSION}


class SimulatedController:
    """A C4G with its robot; the peer of a transport in virtual time.

    Attributes:
        truth: planted rotor inertias and friction.
        settings: as given.
        period: cycle [s].
        rejected_replies: replies that were not taken: wrong number, length or content.
    """

    def __init__(
        self,
        urdf: str,
        drive: SimulatedDrive,
        truth: PlantTruth,
        settings: ControllerSettings,
        *,
        seed: int,
        effects: UnmodelledEffects = NO_EFFECTS,
        initial_position: ArrayLike | None = None,
        gravity: ArrayLike = EARTH,
        announced: SimulatedDrive | None = None,
    ) -> None:
        """Power the cabinet up; the arm rests with closed brakes.

        Args:
            urdf: URDF text with the true inertias.
            drive: what the robot really has; servo and plant work with it.
            truth: rotor inertias and friction of the plant.
            settings: cycle, noise, gains, time table.
            seed: of the model's errors, the noise and the phases of the ripple.
            effects: unmodelled effects, none by default.
            initial_position: joint angles [rad]; the URDF's zero if not given.
            gravity: m/s2 in the base frame.
            announced: what the init packet tells the PC instead of `drive`.

        Raises:
            SettingError: sizes that do not match.
        """
        if truth.n_joints != drive.n_axes or drive.n_axes > 10:
            raise SettingError("drive", f"{drive.n_axes} axes", f"{truth.n_joints}, at most 10")
        model_rng, noise_rng = np.random.default_rng(seed).spawn(2)
        self.truth = truth
        self.settings = settings
        self.period = settings.period
        self.rejected_replies = 0
        self._drive = drive
        self._announced = announced if announced is not None else drive
        self._arm = SimulatedArm(
            urdf, drive, truth, settings,
            effects=effects, gravity=gravity, position=initial_position, rng=noise_rng,
        )  # fmt: skip
        gains, resolution = settings.servo, settings.current_resolution
        model = NominalModel(urdf, truth, gravity=gravity, error=gains.model_error, rng=model_rng)
        self._servo = Servo(
            drive, model, gains, period=settings.period, current_resolution=resolution
        )
        self._servo.start_at(self._arm.encoders())
        self._program = LoopProgram(drive.n_axes, settings)
        self._number = 1 if settings.cold_start else 10
        self._axes = np.zeros(drive.n_axes, AXIS_DTYPE)
        self._awaiting = False

    @property
    def plant(self) -> Plant:
        """The true mechanics: position, velocity, acceleration, friction."""
        return self._arm.plant

    @property
    def servo(self) -> Servo:
        """The servo loops."""
        return self._servo

    @property
    def phase(self) -> Phase:
        """What the controller is doing."""
        return self._program.phase

    @property
    def reason(self) -> str:
        """Why the drive was last lost or the session ended; "" if neither."""
        return self._program.reason

    @property
    def current_delay_cycles(self) -> float:
        """How many cycles after a position its current stands in the recording; see above.

        A deliberate extra delay among the unmodelled effects is not included.
        """
        return 0.5 - self.settings.servo.current_lag / self.period

    def standard_parameters(self) -> dict[str, float]:
        """Return the planted standard parameters by name (m1, mc1x, ..., I6zz, I1m, ...)."""
        return standard_parameters(self.plant.model, self.truth.rotor_inertia)

    def finish(self) -> None:
        """Let the program end: drive off, 504, no more packets. Waits for the arm to stand."""
        self._program.finish()

    def drive_on(self) -> None:
        """Press the operator's button after the drive was lost."""
        self._program.drive_on()

    def emergency_stop(self) -> None:
        """Press the other button: the drive goes off, the brakes close."""
        self._program.trip("emergency stop")

    def next_packet(self) -> bytes | None:
        """Return the packet of the cycle that begins; None once the session has ended.

        A packet that was never followed by `accept` counts as not answered.
        """
        if self._awaiting:
            self.accept(None)
        phase = self._program.phase
        if phase is Phase.ENDED:
            return None
        self._awaiting = True
        if phase is not Phase.START:
            return self._cyclic_packet(phase)
        if self._program.start_step is StartStep.INIT:
            return self._init_packet()
        return CyclicPacket.zeros(self._number, MAX_AXES).encode()

    def accept(self, reply: bytes | None) -> None:
        """Take the PC's answer to the last packet (None: none came) and let one period pass."""
        if not self._awaiting:
            return
        self._awaiting = False
        program, servo = self._program, self._servo
        target, delta = servo.target, [0.0] * self._drive.n_axes
        answer = MISSING
        if reply is not None:
            answer, demand = self._read(reply)
            if demand is not None:
                target, delta = demand
        if not all(map(isfinite, (*target, *delta))):
            program.trip("the PC sent a target that is not a number")
        program.advance(answer, standing=not any(delta))
        self._run(target, delta)
        self._number = next_number(self._number)

    def _run(self, target: Sequence[float], delta: Sequence[float]) -> None:
        """Move the arm for one period and read its encoders."""
        servo, program = self._servo, self._program
        if program.powered:
            self._arm.run_cycle(servo.advance(target, delta), braked=program.braked)
            servo.measure(self._arm.encoders())
            self._watch_following_error()
        else:
            self._arm.run_cycle(None, braked=True)
            servo.measure(self._arm.encoders())
            servo.release()

    def _watch_following_error(self) -> None:
        """Switch the drive off where an axis does not follow."""
        thresholds = self._drive.following_error
        errors = self._servo.following_error()
        for axis, (error, threshold) in enumerate(zip(errors, thresholds, strict=True), start=1):
            if abs(error) > threshold:
                self._program.trip(
                    f"following error of axis {axis}: {error:.3f} motor revolutions, "
                    f"threshold {threshold:g}"
                )

    def _read(self, reply: bytes) -> tuple[Answer, tuple[list[float], list[float]] | None]:
        """Return what a reply asks for, and its targets where they count."""
        starting = self._program.phase is Phase.START
        try:
            if packet_number(reply) != next_number(self._number):
                raise PacketError("number", packet_number(reply), "that of this cycle")
            if starting:
                return Answer(valid=True), None
            packet = CyclicPacket.decode(reply, self._drive.n_axes)
        except PacketError:
            self.rejected_replies += 1
            return MISSING, None
        modes: list[int] = packet.axes["mode"].tolist()
        answer = Answer(
            valid=True,
            exit=packet.status[0] == EXIT_FROM_OPEN,
            drive_off=Mode.DRIVE_OFF_REQUEST in modes,
            following_error=Mode.FOLLOWING_ERROR in modes,
        )
        if answer.drive_off or answer.following_error or not self._program.listening:
            return answer, None
        return answer, self._demand(modes, packet)

    def _demand(self, modes: list[int], packet: CyclicPacket) -> tuple[list[float], list[float]]:
        """Return targets for the next tick; axes that are not open, or not answered, hold."""
        target, delta = list(self._servo.target), [0.0] * self._drive.n_axes
        wanted: list[list[float]] = packet.axes["d"].tolist()
        open_mode = self.settings.open_mode
        for i, is_open in enumerate(self._program.open_axes):
            if is_open and modes[i] == open_mode:
                target[i], delta[i] = wanted[i][:2]
        return target, delta

    def _cyclic_packet(self, phase: Phase) -> bytes:
        """Return the packet of a running exchange."""
        servo, program = self._servo, self._program
        axes = self._axes
        common = _COMMON_MODE.get(phase)
        if common is not None:
            axes["mode"] = common
        else:
            open_mode = self.settings.open_mode
            axes["mode"] = [open_mode if is_open else 0 for is_open in program.open_axes]
        measured = (servo.measured, servo.measured_delta)
        known = program.powered or phase is Phase.TRIPPED
        demanded = (servo.target, servo.delta) if known else ([0.0] * len(axes),) * 2
        axes["d"] = np.array((*demanded, *measured, servo.current)).T
        axes["extra"][:, :2] = np.array((servo.model_current, servo.inertia)).T
        status = _ON if program.powered else _OFF
        return CyclicPacket(self._number, status, _OFF, axes).encode()

    def _init_packet(self) -> bytes:
        """Return the 1200 bytes with what the controller announces about its robot."""
        drive = self._announced
        arm_1: dict[str, ArrayLike] = {
            "calibration": drive.calibration,
            "current_limit": drive.current_limit,
            "kinematic_influence": (0.0, 0.0, 0.0, drive.k54, drive.k64, drive.k65),
            "gear_ratio": drive.gear_ratio,
            "following_error": drive.following_error,
        }
        milliseconds = round(self.period * 1000.0)
        return InitPacket.build(
            drive.n_axes, milliseconds, arm_1, version=self.settings.version
        ).encode()
