"""Facts about the form of friction, which its coefficients have no certain values without."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from identification.arrays import Array
from identification.estimators.friction_form import UNCERTAIN
from identification.text import percentage
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Mask, Naming, Thresholds

FORM: Final = "form of friction"
"""Name of the check whether a friction law lacks a term."""


@dataclass(frozen=True, eq=False)
class FormFacts:
    """Joints whose friction law lacks a term that would change its coefficients."""

    probability: Array  # of such a term (n,)
    share: Array  # change of a coefficient, as torque over the friction (n,)
    lacking: tuple[str, ...]  # the most probable term of each joint (n,)
    joints: Mask  # whose law is uncertain (n,)
    limit: float  # of the change

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> FormFacts | None:
        """Compare the probabilities with the least of an uncertain law; None if not tested."""
        uncertainty = evidence.form
        if uncertainty is None:
            return None
        joints = (uncertainty.probability > UNCERTAIN) & (uncertainty.share > limits.friction)
        lacking = tuple(
            f"{form.label} ({form.speed:g} {speed})" if form.speed_symbol else form.label
            for form, speed in zip(
                uncertainty.forms,
                ("rad/s" if evidence.revolute(j) else "m/s" for j in range(len(uncertainty.forms))),
                strict=True,
            )
        )
        return cls(uncertainty.probability, uncertainty.share, lacking, joints, limits.friction)

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints whose law is uncertain, or that there are none."""
        if not self.joints.any():
            yield Finding(FORM, "good", "no joint's friction law lacks a term that matters")
            return
        terms = naming.each(
            self.joints,
            lambda joint: f"{self.lacking[joint]}, {percentage(self.share[joint])} of its friction",
        )
        joints = naming.of(self.joints)
        yield Finding(
            FORM,
            "doubtful",
            f"the friction law of {joints} lacks a term, such as {terms}; the intervals of its"
            " coefficients allow for that",
            f"describe the friction of {joints} by further terms (`--friction` or"
            " [robot.friction]), or use its curve in the report",
            "symptom",
            reservation=f"the friction law of {joints} is uncertain",
        )
