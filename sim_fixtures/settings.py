"""Settings of the simulated controller; every default is a guess at an industrial controller."""

from __future__ import annotations

from dataclasses import dataclass, fields
from math import inf, isfinite

from sim_fixtures.errors import SettingError


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
        deadband_counts: encoder counts within which a standing axis stops integrating.
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
        open_mode: mode that the controller's program opens the axes in; 4 is absolute position.
        substeps: integration steps of the plant per cycle.
        current_noise: standard deviation of the current that flows about the target, A; white
            from cycle to cycle, on each axis.
        current_resolution: step of the target current, A; 0 for none.
        encoder_noise: standard deviation of a reading before it is rounded, encoder counts. Also
            what makes the servo's current tremble at standstill.
        servo: gains.
        cold_start: begin with nine sync packets, init, two more; otherwise init comes first.
        drive_off_cycles, driving_on_cycles, closed_cycles, closing_cycles: duration of each phase.
            `closed_cycles` passes before every opening.
        opening_stagger: cycles between one axis entering open mode and the next.
        missed_replies: replies missing in a row that end open mode. Meanwhile and afterwards the
            last target is held; at speed that stop is so hard that the drive trips.
        silence_limit: replies missing in a row, in any state, that end the session.
        open_intervals: how often the program opens before it ends by itself; None for endlessly.
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
    missed_replies: int = 1
    silence_limit: int = 1000
    open_intervals: int | None = None
    version: tuple[int, int, int] = (3, 20, 305)

    def __post_init__(self) -> None:
        milliseconds = self.period * 1000.0
        if not (milliseconds >= 0.999 and abs(milliseconds - round(milliseconds)) < 1e-9):
            raise SettingError("period", self.period, "a whole number of milliseconds, in seconds")
        for name in ("current_noise", "current_resolution", "encoder_noise", "opening_stagger"):
            _require(self, name, 0.0)
        for field in fields(self):
            if field.name.endswith("_cycles") or field.name in (
                "substeps",
                "missed_replies",
                "silence_limit",
            ):
                _require(self, field.name, 1.0)
        if self.open_mode not in (4, 5):
            raise SettingError("open_mode", self.open_mode, "4 or 5, position by the PC")
