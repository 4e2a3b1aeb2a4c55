"""Errors of the simulated cell; all derive from `SimulationError`."""

from __future__ import annotations


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
