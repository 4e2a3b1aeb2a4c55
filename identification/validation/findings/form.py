"""Findings about the form of friction, without which its coefficients have no certain values."""

from __future__ import annotations

from identification.estimators.friction_form import UNCERTAIN_PROBABILITY
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Thresholds


def form_of_friction(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the joints whose law lacks a term that would change it, or that there are none."""
    uncertainty = evidence.form
    if uncertainty is None:
        return None
    joints = (uncertainty.probability > UNCERTAIN_PROBABILITY) & (
        uncertainty.share > limits.friction
    )
    if not joints.any():
        return Finding("complete friction law", "good")
    terms = []
    for joint, form in enumerate(uncertainty.forms):
        unit = "rad/s" if evidence.revolute(joint) else "m/s"
        terms.append(f"{form.label} ({form.speed:g} {unit})" if form.speed_symbol else form.label)
    found = Finding("friction law lacks a term", "doubtful", "describe the friction", "symptom")
    return found.about(joints, term=terms, friction=uncertainty.share)
