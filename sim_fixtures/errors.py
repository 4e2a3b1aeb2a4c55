"""What can go wrong in the simulated cell.

SimulationError
├── FixtureError        a figure of a fixture is impossible
├── SettingError        a setting that the simulation cannot run with: name, value, what is valid
└── PlantDiverged       the integration left the finite numbers: joint, time
"""

from __future__ import annotations


class SimulationError(Exception):
    """Base of every error raised by the simulated cell."""


class FixtureError(SimulationError):
    """A fixture's figures contradict each other."""


class SettingError(SimulationError, ValueError):
    """A setting is out of range or of the wrong size.

    Attributes:
        name: the setting.
        value: what was given.
        valid: what would have been valid, in words.
    """

    def __init__(self, name: str, value: object, valid: str) -> None:
        self.name = name
        self.value = value
        self.valid = valid
        super().__init__(f"{name} = {value!r} is not valid: {valid}")


class PlantDiverged(SimulationError):  # noqa: N818 - the field says "diverged", not "error"
    """The simulated arm left the finite numbers.

    Attributes:
        joint: 0-based index of the first joint concerned.
        time: simulated time [s].
    """

    def __init__(self, joint: int, time: float) -> None:
        self.joint = joint
        self.time = time
        super().__init__(
            f"the simulated arm diverged at joint {joint + 1} after {time:.3f} s; "
            "use more sub-steps per cycle or softer servo gains"
        )
