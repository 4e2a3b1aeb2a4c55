"""Settings of the simulated controller, assumed for an industrial one, and errors of the cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Literal


class SimulationError(Exception):
    """Base of every error of the simulated cell."""


class SettingError(SimulationError, ValueError):
    """A setting is out of range or of the wrong size; `valid` states what is valid."""

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name = name
        self.value = value
        self.valid = valid
        super().__init__(f"{name} = {value!r} is not valid: {valid}")


class PlantDiverged(SimulationError):  # noqa: N818 - the field says "diverged", not "error"
    """The state of the simulated arm is not finite; `joint` counts from 0, `time` in s."""

    def __init__(self, joint: int, time: float) -> None:
        self.joint = joint
        self.time = time
        super().__init__(
            f"the simulated arm diverged at joint {joint + 1} after {time:.3f} s; "
            "use more sub-steps per cycle or softer servo gains"
        )


WhileSilent = Literal["hold", "continue", "drive_off"]

WHILE_SILENT: Final[tuple[WhileSilent, ...]] = ("hold", "continue", "drive_off")
OPEN_MODES: Final = (1, 2, 4, 5, 7, 8, 9)
CORRECTED_MODES: Final = (2, 7, 8, 9)
"""Open modes in which the controller generates the targets and the PC corrects them."""
AXES_PER_ARM: Final = 10


@dataclass(frozen=True)
class ServoSettings:
    """Gains of the position-velocity-current cascade."""

    position_gain: float = 20.0  # demanded speed per position error, 1/s
    velocity_bandwidth: float = 120.0  # of the velocity loop with the inertia of the joint, rad/s
    rotor_bandwidth: float = 400.0  # its upper bound with the inertia of the rotor alone, rad/s
    integral_rate: float = 15.0  # of the integral part of the velocity loop, 1/s
    current_lag: float = 0.0003  # time constant of the current loop, s
    model_error: tuple[float, float] = (0.05, 0.10)  # relative, of the built-in dynamic model
    deadband_counts: float = 3.0  # error in encoder counts that a resting axis does not integrate


@dataclass(frozen=True)
class ControllerSettings:
    """Cycle, noise and timing of the controller, in cycles unless a unit is given.

    `while_silent` is the motion in open mode without a valid target. "hold": the last target is
    held; at speed this can trip the drive. "continue": the last velocity continues, and after the
    end of open mode decreases to zero within `ramp_time`. "drive_off": the last target is held, and
    the drive is switched off when missing replies end open mode.

    The controller's program moves through the postures `own_motion` [rad] with closed axes before
    it ends the session; in corrected modes, with open axes.
    """

    period: float = 0.001  # s; an integer number of ms
    open_mode: int = 4  # 1, 2, 4, 5, 7, 8 or 9
    substeps: int = 2  # integration steps of the plant per period of the servo loops
    current_noise: float = 0.0  # standard deviation of the actual current, A; white
    current_resolution: float = 0.0  # step of the target current, A; 0 for none
    encoder_noise: float = 0.5  # standard deviation before rounding, encoder counts
    servo: ServoSettings = ServoSettings()
    cold_start: bool = True  # nine sync packets, init, two more sync packets; else init only
    drive_off_cycles: int = 20
    driving_on_cycles: int = 50
    closed_cycles: int = 20  # before every opening
    closing_cycles: int = 5
    opening_stagger: int = 3  # between one axis entering open mode and the next
    only_axis: int | None = None  # the only axis (from 1) that the program opens; None for all
    closing_stagger: int = 0  # between one axis leaving open mode and the next
    missed_replies: int = 1  # consecutive missing replies that end open mode
    lost_openings: int | None = None  # consecutive ones, by missing replies, that end the session
    reopening_time: float = 0.0  # least time before the next opening after a lost one, s
    while_silent: WhileSilent = "hold"
    ramp_time: float = 0.2  # time in which a moving axis without a target stops, s
    silence_limit: int = 1000  # consecutive missing replies, in any state, that end the session
    open_intervals: int | None = None  # openings before the program ends; None for no limit
    boot_time: float = 2.0  # silence of a controller that was restarted cold, s
    arm: int = 1  # 1..4
    slots: tuple[int, ...] | None = None  # of each axis in the packets; None for 0, 1, 2, ...
    foreign_axes: int = 0  # axes of other arms in the other slots, at rest
    foreign_open: bool = False  # whether those open with this arm and move to the targets sent
    long_packets: bool = False  # 732 bytes for any number of axes; random bytes follow the axes
    own_motion: tuple[tuple[float, ...], ...] = ()
    own_motion_repeats: bool = False  # move back and forth through the postures until `finish`
    version: tuple[int, int, int] = (3, 20, 305)  # major, minor, build in the init packet

    def __post_init__(self) -> None:
        if self.open_mode not in OPEN_MODES:
            modes = ", ".join(map(str, OPEN_MODES))
            raise SettingError("open_mode", self.open_mode, f"one of {modes}")

    @property
    def corrected(self) -> bool:
        """Whether the PC corrects targets of the controller in open mode."""
        return self.open_mode in CORRECTED_MODES
