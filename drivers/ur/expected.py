"""Which arm is expected at the other end of a link, and how the one that is there differs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from drivers.ur.identity import ArmIdentity

PAYLOAD_TOLERANCE: Final = 0.02
"""Largest difference of two payloads that count as one [kg]."""
CENTRE_TOLERANCE: Final = 0.01
"""The same of their centres of mass [m]."""


@dataclass(frozen=True)
class ExpectedArm:
    """The arm of a cell; "" for what may be any.

    Attributes:
        serial_number, model, calibration: as in `ArmIdentity`, the model by `ArmIdentity.named`.
        payload: mass that is to be set at the controller [kg].
        centre: its centre of mass in the frame of the flange [m]; None for any.
    """

    serial_number: str = ""
    model: str = ""
    calibration: str = ""
    payload: float = 0.0
    centre: tuple[float, float, float] | None = None

    def stated(self) -> Mapping[str, str]:
        """Return what is expected, by what it is."""
        texts = {
            "serial number": self.serial_number,
            "type": self.model,
            "calibration": self.calibration,
        }
        return {name: text for name, text in texts.items() if text}

    def differences(self, identity: ArmIdentity, major: int) -> tuple[str, ...]:
        """Return what the arm states otherwise, a sentence each; what it leaves out does not."""
        found = stated_by(identity, major)
        return tuple(
            f"its {name} is {found[name]}, but the cell states {text}"
            for name, text in self.stated().items()
            if found.get(name, text) != text
        )

    def unchecked(self, identity: ArmIdentity) -> tuple[str, ...]:
        """Return what the arm could not be asked of all that is expected."""
        return tuple(sorted(self.stated().keys() - stated_by(identity, 5).keys()))

    def payload_difference(self, mass: float, centre: tuple[float, float, float]) -> str:
        """Return how the payload set at the controller differs, or "".

        NaN, of a version that does not state it, differs from nothing.
        """
        if abs(mass - self.payload) > PAYLOAD_TOLERANCE:
            return (
                f"the controller is set to a payload of {mass:g} kg, [robot.payload] of the cell "
                f"to {self.payload:g} kg"
            )
        if self.centre is not None and any(
            abs(there - here) > CENTRE_TOLERANCE
            for there, here in zip(centre, self.centre, strict=True)
        ):
            there, here = (", ".join(f"{v:g}" for v in xyz) for xyz in (centre, self.centre))
            return (
                f"the controller is set to a payload centred at {there} m, [robot.payload] of the "
                f"cell at {here} m"
            )
        return ""


def stated_by(identity: ArmIdentity, major: int) -> dict[str, str]:
    """Return what an arm states of itself, by what it is, for a major version of the software."""
    texts = {
        "serial number": identity.serial_number,
        "type": identity.named(major),
        "calibration": identity.calibration,
    }
    return {name: text for name, text in texts.items() if text is not None}
