"""Settings of the simulated controller; every default is a guess at an industrial controller."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import inf, isfinite
from typing import Final, Literal

from sim_fixtures.errors import SettingError

WhileSilent = Literal["hold", "continue", "drive_off"]

WHILE_SILENT: Final[tuple[WhileSilent, ...]] = ("hold", "continue", "drive_off")
OPEN_MODES: Final = (1, 2, 4, 5, 7, 8, 9)
CORRECTED_MODES: Final = (2, 7, 8, 9)
"""Open modes in which the controller goes on making its own targets, and the PC corrects."""
AXES_PER_ARM: Final = 10
ARMS: Final = 4
MAX_SLOTS: Final = 20


def _require(
    owner: object, name: str, lower: float, upper: float = inf, *, exclusive: bool = False
) -> None:
    """Raise SettingError unless the named number is finite and within its bounds."""
    value = getattr(owner, name)
    above = value > lower if exclusive else value >= lower
    if not (isfinite(value) and above and value <= upper):
        relation = "greater than" if exclusive else "at least"
        raise SettingError(name, value, f"a finite number {relation} {lower:g}")


@dataclass(frozen=True)
class ServoSettings:
    """Gains of the position-velocity-current cascade.

    Attributes:
        position_gain: speed demanded per position error, 1/s.
        velocity_bandwidth: of the velocity loop on the inertia the joint shows, rad/s.
        rotor_bandwidth: bound on the same gain over the rotor's own inertia, rad/s. Above the
            resonance of its gear a motor feels little more than its rotor; a loop tuned for the
            whole arm would be unstable on a real gear.
        integral_rate: of the velocity loop's integral part, 1/s.
        current_lag: time constant of the current loop, s.
        model_error: range of the relative errors of the built-in dynamic model; each link's
            inertia, each rotor and each friction figure is off by one of them, either way.
        deadband_counts: encoder counts within which a resting axis stops integrating.
    """

    position_gain: float = 20.0
    velocity_bandwidth: float = 120.0
    rotor_bandwidth: float = 400.0
    integral_rate: float = 15.0
    current_lag: float = 0.0003
    model_error: tuple[float, float] = (0.05, 0.10)
    deadband_counts: float = 3.0

    def __post_init__(self) -> None:
        for name in ("position_gain", "velocity_bandwidth", "rotor_bandwidth"):
            _require(self, name, 0.0, exclusive=True)
        for name in ("integral_rate", "current_lag", "deadband_counts"):
            _require(self, name, 0.0)
        low, high = self.model_error
        if not 0.0 <= low <= high < 1.0:
            raise SettingError("model_error", self.model_error, "0 <= low <= high < 1")


@dataclass(frozen=True)
class ControllerSettings:
    """The controller's cycle, noise and time table. Numbers of cycles unless a unit is given.

    Attributes:
        period: cycle, s; a whole number of ms, for so it stands in the init packet.
        open_mode: mode that the controller's program opens the axes in: 1, 2, 4, 5, 7, 8 or 9.
        substeps: integration steps of the plant per cycle.
        current_noise: standard deviation of the current that flows about the target, A; white
            from cycle to cycle, on each axis.
        current_resolution: step of the target current, A; 0 for none.
        encoder_noise: standard deviation of a reading before it is rounded, encoder counts. Also
            what makes the servo's current tremble at standstill.
        servo: gains.
        cold_start: begin with nine sync packets, init, two more; otherwise init comes first.
        boot_time: s of silence before a controller that was restarted cold speaks again.
        drive_off_cycles, driving_on_cycles, closed_cycles, closing_cycles: duration of each phase.
            `closed_cycles` passes before every opening.
        opening_stagger: cycles between one axis entering open mode and the next.
        only_axis: number, from 1, of the only axis that the program opens; None for all.
        closing_stagger: cycles between one axis leaving open mode and the next.
        missed_replies: replies missing in a row that end open mode.
        lost_openings: openings in a row that were lost to missing replies and end the session;
            None for never. One that the PC ended, or that led to a lost drive, begins anew.
        reopening_time: s that pass at least before the axes open again after such a loss.
        while_silent: what the arm does in open mode without a target it can use. "hold": the last
            target is held, during and after; at speed that stop is so hard that the drive trips.
            "continue": it goes on at the velocity of the last target, and once open mode has ended
            comes to rest within `ramp_time`. "drive_off": the last target is held, and where
            replies missing end open mode, the drive goes off with it.
        ramp_time: s in which a moving axis that nobody leads any more is brought to rest.
        silence_limit: replies missing in a row, in any state, that end the session.
        open_intervals: how often the program opens before it ends by itself; None for endlessly.
        arm: number of this arm, 1..4.
        slots: slot of each axis in the packets; None for 0, 1, 2, ...
        foreign_axes: axes of other arms in the packets, in the slots that are left; at rest.
        foreign_open: whether those open together with this arm; they obey what they are sent.
        long_packets: send 732 bytes whatever the number of axes; what follows the axes is garbage.
        own_motion: joint angles [rad] of postures that the controller's own program moves to, one
            after the other, with closed axes; then it ends the session. In a mode in which the
            PC only corrects, it moves while the axes are open.
        own_motion_repeats: go to and fro through these postures until asked to finish.
        own_speed: of those moves, as a fraction of the URDF's velocity limits.
        version: major, minor, build in the init packet.
    """

    period: float = 0.001
    open_mode: int = 4
    substeps: int = 2
    current_noise: float = 0.0
    current_resolution: float = 0.0
    encoder_noise: float = 0.5
    servo: ServoSettings = ServoSettings()
    cold_start: bool = True
    drive_off_cycles: int = 20
    driving_on_cycles: int = 50
    closed_cycles: int = 20
    closing_cycles: int = 5
    opening_stagger: int = 3
    only_axis: int | None = None
    closing_stagger: int = 0
    missed_replies: int = 1
    lost_openings: int | None = None
    reopening_time: float = 0.0
    while_silent: WhileSilent = "hold"
    ramp_time: float = 0.2
    silence_limit: int = 1000
    open_intervals: int | None = None
    boot_time: float = 2.0
    arm: int = 1
    slots: tuple[int, ...] | None = None
    foreign_axes: int = 0
    foreign_open: bool = False
    long_packets: bool = False
    own_motion: tuple[tuple[float, ...], ...] = ()
    own_motion_repeats: bool = False
    own_speed: float = 0.3
    version: tuple[int, int, int] = (3, 20, 305)

    def __post_init__(self) -> None:
        milliseconds = self.period * 1000.0
        if not (milliseconds >= 0.999 and abs(milliseconds - round(milliseconds)) < 1e-9):
            raise SettingError("period", self.period, "a whole number of milliseconds, in seconds")
        for name in (
            "current_noise",
            "current_resolution",
            "encoder_noise",
            "opening_stagger",
            "closing_stagger",
            "boot_time",
            "reopening_time",
            "foreign_axes",
        ):
            _require(self, name, 0.0)
        for field in fields(self):
            if field.name.endswith("_cycles") or field.name in (
                "substeps",
                "missed_replies",
                "silence_limit",
            ):
                _require(self, field.name, 1.0)
        if self.lost_openings is not None:
            _require(self, "lost_openings", 1.0)
        if self.only_axis is not None:
            _require(self, "only_axis", 1.0)
        _require(self, "ramp_time", 0.0, exclusive=True)
        _require(self, "own_speed", 0.0, 1.0, exclusive=True)
        self._check_choices()

    def _check_choices(self) -> None:
        if self.open_mode not in OPEN_MODES:
            modes = ", ".join(map(str, OPEN_MODES))
            raise SettingError("open_mode", self.open_mode, f"one of {modes}")
        if self.while_silent not in WHILE_SILENT:
            raise SettingError("while_silent", self.while_silent, f"one of {WHILE_SILENT}")
        if not 1 <= self.arm <= ARMS:
            raise SettingError("arm", self.arm, f"1..{ARMS}")
        if not all(isfinite(angle) for posture in self.own_motion for angle in posture):
            raise SettingError("own_motion", self.own_motion, "finite joint angles")

    @property
    def corrected(self) -> bool:
        """Whether the controller makes the targets of open axes, and the PC corrects them."""
        return self.open_mode in CORRECTED_MODES
