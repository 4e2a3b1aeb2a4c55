"""Findings about the torque error on held-out motion."""

from __future__ import annotations

from typing import Final

import numpy as np

from identification.arrays import Array
from identification.hypotheses.little_torque import little_torque
from identification.validation.evidence import Evidence
from identification.validation.finding import (
    Finding,
    FindingKey,
    Level,
    Mask,
    RemedyKey,
    Thresholds,
    Value,
)

# Ratio of torque errors that is no chance: three standard deviations of 24 blocks, as in 12 s.
_MIN_ERROR_GROWTH: Final = 1.5
# Where torque and its prediction are noise of the same size, the error is this share of the torque.
_NOISE_ALONE_ERROR: Final = 2.0**0.5


def _minor(evidence: Evidence, limits: Thresholds) -> Mask:
    """Return axes whose torque is too small to condemn a model alone (n,).

    It is lost in its noise, or small against that of the other axes or against its own limit.
    """
    error = evidence.held_out
    torque = error.torque_rms
    slides = np.isin(np.arange(len(torque)), evidence.prismatic)
    minor = little_torque(torque, slides, limits.minor) | _lost_in_noise(evidence, limits)
    if (most := evidence.context.torque_limit) is not None:
        minor |= torque < limits.minor_of_limit * np.nan_to_num(most)
    return np.asarray(minor & (error.rows > 0))


def _lost_in_noise(evidence: Evidence, limits: Thresholds) -> Mask:
    """Return axes whose torque is lost in its noise (n,)."""
    torque = evidence.held_out.torque_rms
    if evidence.noise_floor is None:
        return np.zeros(len(torque), dtype=np.bool_)
    return np.asarray(np.nan_to_num(evidence.noise_floor) > 0.5 * limits.axis * torque)


def _growth(evidence: Evidence, limits: Thresholds) -> tuple[Array, Mask]:
    """Return the error of each axis on held-out over fitted motion, and where it is large (n,)."""
    relative = evidence.held_out.relative
    growth = relative / np.maximum(evidence.training.relative, 1e-12)
    # An error below that of a pattern is one of rounding or smoothing.
    return growth, (growth > limits.generalisation) & (relative > limits.pattern)


def overall_error(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return an error over all axes beyond its limit; None where no fault explains it either."""
    overall = evidence.held_out.overall
    limit = evidence.allowed(limits)
    if not overall > limit or unexplained_error(evidence, limits) is not None:
        return None
    values: dict[str, Value] = {"overall": overall, "limit": limit}
    return Finding("overall error", "wrong", _overall_step(evidence, limits), "symptom", values)


def _overall_step(evidence: Evidence, limits: Thresholds) -> RemedyKey:
    """Return what to do about an error over all axes, of the fitted motion or of another."""
    overall = evidence.held_out.overall
    covered = not overall > limits.generalisation * evidence.training.overall
    return "describe elements, or check the drives" if covered else "cover the motion"


def axis_error(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the axes whose error exceeds its limit on fitted and held-out motion."""
    relative = evidence.held_out.relative
    _, grown = _growth(evidence, limits)
    joints = (relative > limits.axis) & ~grown & ~_minor(evidence, limits)
    if not joints.any():
        return None
    limit = {"limit": limits.axis}
    return Finding("axis error", "wrong", "check the drives", "symptom", limit).about(
        joints, relative=relative
    )


def noisy_axis_error(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return such axes of little torque whose error may be noise alone."""
    relative = evidence.held_out.relative
    joints = (relative > limits.axis) & ~(relative > _NOISE_ALONE_ERROR)
    return _of_little_torque(evidence, limits, joints, "move faster")


def axis_error_of_little_torque(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return such axes of little torque whose error is more than noise."""
    _, grown = _growth(evidence, limits)
    joints = (evidence.held_out.relative > max(limits.axis, _NOISE_ALONE_ERROR)) & ~grown
    return _of_little_torque(evidence, limits, joints, "check the drives and the unit")


def grown_axis_error_of_little_torque(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return such axes of little torque whose error is large on held-out motion alone."""
    _, grown = _growth(evidence, limits)
    joints = (evidence.held_out.relative > max(limits.axis, _NOISE_ALONE_ERROR)) & grown
    return _of_little_torque(evidence, limits, joints, "cover the motion")


def _of_little_torque(
    evidence: Evidence, limits: Thresholds, large: Mask, remedy: RemedyKey
) -> Finding | None:
    joints = large & _minor(evidence, limits)
    if not joints.any():
        return None
    error = evidence.held_out
    limit = {"limit": limits.axis}
    units = ["N·m" if evidence.revolute(joint) else "N" for joint in range(len(joints))]
    return Finding("axis error of little torque", "doubtful", remedy, "symptom", limit).about(
        joints, relative=error.relative, torque=error.torque_rms, unit=units
    )


def grown_axis_error(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the axes whose error exceeds its limit on held-out motion alone."""
    relative = evidence.held_out.relative
    _, grown = _growth(evidence, limits)
    joints = (relative > limits.axis) & grown & ~_minor(evidence, limits)
    if not joints.any():
        return None
    key: FindingKey = "axis error on unseen motion alone"
    limit = {"limit": limits.axis}
    return Finding(key, "wrong", "cover the motion", "symptom", limit).about(
        joints, relative=relative
    )


def unexplained_error(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return an error far above the noise that no tested fault explains.

    None if faults were found, or not tested.
    """
    floor = evidence.floor
    found = evidence.explanations
    if floor is None or found is None or found:
        return None
    overall = evidence.held_out.overall
    if not overall > max(limits.unexplained, limits.multiple * floor):
        return None
    limit = evidence.allowed(limits)
    values: dict[str, Value] = {
        "overall": overall,
        "floor": floor,
        "floors": overall / max(floor, 1e-300),
    }
    if overall > limit:
        values["limit"] = limit
        step = _overall_step(evidence, limits)
        return Finding("unexplained error", "wrong", step, "symptom", values)
    step = "check for missing effects"
    return Finding("unexplained error", "doubtful", step, "symptom", values)


def left_open(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return that the error does not distinguish models of the same fit.

    None if it is small, or less is open.
    """
    share = evidence.open_share
    overall = evidence.held_out.overall
    if share is None or not share >= overall > limits.unexplained:
        return None
    values: dict[str, Value] = {
        "fitted": evidence.training.overall,
        "open": share,
        "overall": overall,
    }
    step: RemedyKey = "cover the motion in both directions"
    return Finding("undetermined by the motion", "doubtful", step, values=values)


def _unexplained_axes(evidence: Evidence, limits: Thresholds) -> tuple[Mask, Mask]:
    """Return axes that the mean predicts as well, and others with little explained (n,)."""
    explained = evidence.held_out.explained
    nothing = (explained <= limits.explained) & ~_minor(evidence, limits)
    return nothing, (explained < limits.little_explained) & ~nothing


def _beyond_noise(evidence: Evidence) -> Mask:
    """Return axes whose error exceeds what noise alone explains (n,)."""
    return np.asarray(evidence.held_out.relative > _NOISE_ALONE_ERROR)


def nothing_explained_by_noise(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes predicted no better than by the mean, whose error may be noise alone."""
    nothing, _ = _unexplained_axes(evidence, limits)
    return _nothing(nothing & ~_beyond_noise(evidence), limits, "move faster")


def nothing_explained(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes predicted no better than by the mean, whose error is more than noise."""
    nothing, _ = _unexplained_axes(evidence, limits)
    return _nothing(nothing & _beyond_noise(evidence), limits, "check the drives and the unit")


def _nothing(joints: Mask, limits: Thresholds, remedy: RemedyKey) -> Finding | None:
    if not joints.any():
        return None
    limit = {"limit": limits.explained}
    return Finding("nothing explained", "wrong", remedy, "symptom", limit).about(joints)


def little_explained_by_noise(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes with little explained whose error may be noise alone."""
    _, little = _unexplained_axes(evidence, limits)
    return _little(evidence, little & ~_beyond_noise(evidence), limits, "move faster")


def little_explained(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes with little explained whose error exceeds noise."""
    _, little = _unexplained_axes(evidence, limits)
    beyond = little & _beyond_noise(evidence)
    return _little(evidence, beyond, limits, "check the drives and the unit")


def _little(
    evidence: Evidence, joints: Mask, limits: Thresholds, remedy: RemedyKey
) -> Finding | None:
    if not joints.any():
        return None
    limit = {"limit": limits.little_explained}
    return Finding("little explained", "doubtful", remedy, "symptom", limit).about(
        joints, explained=evidence.held_out.explained
    )


def explained(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return the least explained axis, if enough of each is explained."""
    nothing, little = _unexplained_axes(evidence, limits)
    share = evidence.held_out.explained
    if (nothing | little).any() or np.all(np.isnan(share)):
        return None
    least = int(np.nanargmin(share))
    values = {"least": float(share[least])}
    return Finding("explained", "good", values=values, joints=(least,))


def _far_generalisation(evidence: Evidence, limits: Thresholds) -> tuple[Array, Mask, Mask]:
    """Return the growth of the errors, and where it is large: of a large error, of a small (n,)."""
    error = evidence.held_out
    growth, grown = _growth(evidence, limits)
    # Less torque on unseen motion alone raises the share.
    ratio = error.rms / np.maximum(evidence.training.rms, 1e-300)
    least = np.where(ratio > _MIN_ERROR_GROWTH, limits.unexplained, 0.5 * limits.axis)
    # Little torque does not excuse an axis that was fitted several times better.
    far = grown & (error.relative > least) & ~_lost_in_noise(evidence, limits)
    return growth, far, grown & ~far


def poor_generalisation(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes whose error is large, and several times the error of the fitted motion."""
    growth, far, _ = _far_generalisation(evidence, limits)
    return _generalisation(evidence, limits, growth, far, "wrong")


def weak_generalisation(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes whose error is small, but several times the error of the fitted motion."""
    growth, _, near = _far_generalisation(evidence, limits)
    return _generalisation(evidence, limits, growth, near, "doubtful")


def _generalisation(
    evidence: Evidence, limits: Thresholds, growth: Array, joints: Mask, level: Level
) -> Finding | None:
    if not joints.any():
        return None
    step: RemedyKey = "cover the motion, or check what changed"
    limit = {"limit": limits.generalisation}
    return Finding("generalisation", level, step, "symptom", limit).about(
        joints, growth=growth, relative=evidence.held_out.relative
    )


def no_repetitions(evidence: Evidence, _: Thresholds) -> Finding | None:
    """Return that slow errors beyond noise were not tested, as no motion was repeated."""
    if evidence.systematic is not None:
        return None
    return Finding("no repetitions", "doubtful", "repeat the motion")


def large_systematic_error(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes of a large slow error, whatever their friction."""
    if evidence.systematic is None:
        return None
    share = np.nan_to_num(evidence.systematic)
    apart = evidence.systematic_without_friction
    apart = share if apart is None else np.nan_to_num(apart)
    joints = (share > limits.systematic) & (apart > limits.systematic)
    return _systematic(share, joints, "wrong", "check the coupling", limits.systematic)


def noticeable_systematic_error(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes of a noticeable slow error."""
    if evidence.systematic is None:
        return None
    share = np.nan_to_num(evidence.systematic)
    joints = (share > limits.noticeable) & (share <= limits.systematic)
    step: RemedyKey = "check the constant with a payload"
    return _systematic(share, joints, "doubtful", step, limits.noticeable)


def _systematic(
    share: Array, joints: Mask, level: Level, remedy: RemedyKey, limit: float
) -> Finding | None:
    if not joints.any():
        return None
    values = {"limit": limit}
    return Finding("systematic error", level, remedy, "symptom", values).about(joints, slow=share)


def different_repetitions(evidence: Evidence, limits: Thresholds) -> Finding | None:
    """Return axes whose torque differs between the estimates of single repetitions.

    Undetermined parameters vary between repetitions.
    """
    share = evidence.disagreement
    if share is None or evidence.estimate.undetermined:
        return None
    joints = share > limits.inconsistency
    if not joints.any():
        return None
    limit = {"limit": limits.inconsistency}
    return Finding("different repetitions", "wrong", "compare the repetitions", values=limit).about(
        joints, difference=share
    )
