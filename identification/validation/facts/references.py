"""Facts about other models of the arm: the nominal one, and the controller's own."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.text import percentage
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Mask, Naming, Thresholds

_INERTIA_OFF: Final = 1.2  # ratio of inertias; data sheets are accurate to 10 %


@dataclass(frozen=True)
class NominalFacts:
    """Error of the nominal model on held-out motion, over all axes."""

    nominal: float
    with_friction: float  # and with the friction of the fitted motion
    identified: float
    better: bool  # whether the nominal model predicts better, with friction or without

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> NominalFacts | None:
        """Compare it with the error of the identified model."""
        if evidence.nominal is None:
            return None
        nominal = evidence.nominal.overall
        friction = evidence.nominal_with_friction
        with_friction = nominal if friction is None else friction.overall
        identified = evidence.held_out.overall
        better = identified > min(nominal, with_friction) + limits.nominal
        return cls(nominal, with_friction, identified, better)

    def findings(self, _: Naming) -> Iterator[Finding]:
        """Yield which model predicts better."""
        nominal = percentage(self.nominal, 1)
        identified = percentage(self.identified, 1)
        if self.with_friction != self.nominal:
            nominal += f" ({percentage(self.with_friction, 1)} with fitted friction)"
        if self.better:
            yield Finding(
                "against the nominal model",
                "wrong",
                f"the nominal model predicts better: error {nominal}, identified model"
                f" {identified}",
                "use the nominal model, or fit a longer and more varied motion",
                "symptom",
            )
        else:
            yield Finding(
                "against the nominal model",
                "good",
                f"the error of the nominal model is {nominal}, of the identified model"
                f" {identified}",
            )


@dataclass(frozen=True)
class ControllerFacts:
    """Error of the controller's dynamic model on held-out motion, over all axes."""

    controller: float
    identified: float
    better: bool  # whether the controller's model predicts better

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> ControllerFacts | None:
        """Compare it with the error of the identified model."""
        if evidence.context.controller is None:
            return None
        controller = evidence.context.controller.overall
        identified = evidence.held_out.overall
        return cls(controller, identified, identified > controller + limits.nominal)

    def findings(self, _: Naming) -> Iterator[Finding]:
        """Yield which model predicts better."""
        controller = percentage(self.controller, 1)
        identified = percentage(self.identified, 1)
        if self.better:
            yield Finding(
                "against the controller's model",
                "doubtful",
                f"the controller's own dynamic model predicts better: error {controller},"
                f" identified model {identified}",
                "fit a longer and more varied motion before replacing the controller's model",
                "symptom",
            )
        else:
            yield Finding(
                "against the controller's model",
                "good",
                f"the error of the controller's own dynamic model is {controller}, of the"
                f" identified model {identified}",
            )


@dataclass(frozen=True, eq=False)
class InertiaFacts:
    """The controller's inertia of each joint over the identified one."""

    ratio: Array  # (n,), NaN where unknown
    off: Mask  # joints of another inertia (n,)

    @classmethod
    def of(cls, evidence: Evidence) -> InertiaFacts | None:
        """Compare the ratios with their limit."""
        inertia = evidence.context.controller_inertia
        if inertia is None:
            return None
        return cls(inertia.ratio, np.abs(np.log(inertia.ratio)) > np.log(_INERTIA_OFF))

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints of another inertia, or the ratios of all."""

        def ratio(joint: int) -> str:
            return f"{self.ratio[joint]:.2f}"

        comparable = np.isfinite(self.ratio)
        if self.off.any():
            yield Finding(
                "against the controller's inertia",
                "doubtful",
                "ratio of the controller's inertia (joint side, with rotors) to the identified"
                f" one: {naming.each(self.off, ratio)}",
                f"check torque constant and gear ratio of {naming.of(self.off)}, and the payload",
            )
        elif comparable.any():
            yield Finding(
                "against the controller's inertia",
                "good",
                "the controller's inertia agrees with the identified one: ratio"
                f" {naming.each(comparable, ratio)}",
            )
