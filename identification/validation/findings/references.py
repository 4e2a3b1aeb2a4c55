"""Findings about other models of the arm: the nominal one, and the controller's own."""

from __future__ import annotations

from typing import Final

import numpy as np

from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, RemedyKey, Thresholds, Value

_MAX_INERTIA_RATIO: Final = 1.2  # ratio of inertias; data sheets are accurate to 10 %


def nominal_model(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Compare the errors of nominal and identified model on held-out motion."""
    if evidence.nominal is None:
        return None
    nominal = evidence.nominal.overall
    friction = evidence.nominal_with_friction
    with_friction = nominal if friction is None else friction.overall
    identified = evidence.held_out.overall
    values: dict[str, Value] = {"nominal": nominal, "identified": identified}
    if with_friction != nominal:
        values["fitted_friction"] = with_friction
    if identified > min(nominal, with_friction) + limits.nominal:
        step: RemedyKey = "use the nominal model"
        return Finding("nominal model better", "wrong", step, "symptom", values)
    return Finding("nominal model worse", "good", values=values)


def controller_model(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Compare the errors of the controller's and the identified model on held-out motion."""
    if evidence.context.controller is None:
        return None
    controller = evidence.context.controller.overall
    identified = evidence.held_out.overall
    values: dict[str, Value] = {"controller": controller, "identified": identified}
    if identified > controller + limits.nominal:
        step: RemedyKey = "fit more before replacing the controller's"
        return Finding("controller's model better", "doubtful", step, "symptom", values)
    return Finding("controller's model worse", "good", values=values)


def controller_inertia(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Compare the controller's inertia of each joint with the identified one."""
    inertia = evidence.context.controller_inertia
    if inertia is None:
        return None
    ratio = inertia.ratio
    off = np.abs(np.log(ratio)) > np.log(_MAX_INERTIA_RATIO)
    if off.any():
        step: RemedyKey = "check the constant and the payload"
        return Finding("controller's inertia differs", "doubtful", step).about(off, ratio=ratio)
    comparable = np.isfinite(ratio)
    if not comparable.any():
        return None
    return Finding("controller's inertia agrees", "good").about(comparable, ratio=ratio)
