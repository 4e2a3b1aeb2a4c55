"""All checks of a verdict, in order."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, FindingKey, Thresholds

from . import (
    diagnosis,
    errors,
    excitation,
    faults,
    form,
    patterns,
    recordings,
    references,
    sameness,
    scale,
)

_UNEXPLAINED: Final[FindingKey] = "torque of another run"
Check = Callable[[Evidence, Thresholds], "Finding | tuple[Finding, ...] | None"]

CHECKS: Final[tuple[Check, ...]] = (
    recordings.nothing_held_out,
    recordings.joints_not_fitted,
    recordings.joints_at_rest,
    recordings.no_torque,
    recordings.position_jumps,
    recordings.play,
    excitation.undetermined,
    excitation.undetermined_in_one_direction,
    excitation.poor_excitation,
    excitation.one_direction,
    excitation.good_excitation,
    faults.outliers,
    diagnosis.other_meanings,
    faults.gravity,
    scale.all_torques_opposite,
    scale.all_axes_driven,
    scale.torque_opposite,
    faults.faults,
    diagnosis.another_arm,
    scale.scale_of_torque,
    sameness.load,
    sameness.changed_torque_of_large_errors,
    sameness.changed_torque_of_small_errors,
    sameness.friction,
    diagnosis.another_run,
    scale.physical_signs,
    errors.overall_error,
    errors.axis_error,
    errors.noisy_axis_error,
    errors.axis_error_of_little_torque,
    errors.grown_axis_error_of_little_torque,
    errors.grown_axis_error,
    errors.unexplained_error,
    errors.left_open,
    errors.nothing_explained_by_noise,
    errors.nothing_explained,
    errors.little_explained_by_noise,
    errors.little_explained,
    errors.explained,
    errors.poor_generalisation,
    errors.weak_generalisation,
    errors.no_repetitions,
    errors.large_systematic_error,
    errors.noticeable_systematic_error,
    errors.different_repetitions,
    references.nominal_model,
    references.controller_model,
    references.controller_inertia,
    recordings.delay,
    recordings.corrections,
    recordings.saturation,
    patterns.correlation,
    form.form_of_friction,
    patterns.over_speed,
    patterns.over_position,
    patterns.ripple,
    patterns.friction_drift,
)
"""Every check, in the order of the verdict's reasons: its line has the first one."""


def find(evidence: Evidence, limits: Thresholds) -> list[Finding]:
    """Return all findings, in the order of the verdict's reasons.

    That nothing explains the error, or the torque, is none if a wrong cause does.
    """
    findings: list[Finding] = []
    for check in CHECKS:
        found = check(evidence, limits)
        if isinstance(found, Finding):
            findings.append(found)
        elif found is not None:
            findings += found
    causes = [each.key for each in findings if each.role == "cause" and each.level == "wrong"]
    left_out: list[FindingKey] = ["unexplained error"] if causes else []
    if causes[:1] != [_UNEXPLAINED]:
        left_out.append(_UNEXPLAINED)
    return [each for each in findings if each.key not in left_out]
