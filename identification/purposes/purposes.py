"""The purposes of a model: what each figure is, and the limit that it is held against."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from identification.arrays import Array
from identification.errors import IdentificationError
from identification.factor.estimate import Estimate
from identification.model.robot import RobotModel
from identification.purposes.contact import contact, seen_mass
from identification.purposes.gravity_error import gravity_error, workspace
from identification.purposes.quiet_torque import FALSE_ALARM_PERIOD, SlowResidual, slow_residuals
from identification.purposes.simulation_error import HORIZON_SECONDS, flange_error
from identification.purposes.thresholds import ContactThreshold, contact_thresholds
from identification.signals.samples import Samples
from identification.validation.evidence import Evidence
from identification.validation.finding import Thresholds
from identification.validation.purpose import Purpose, PurposeLimits


@dataclass(frozen=True, eq=False)
class Application:
    """What is known of an identified arm and of the motion that it predicts.

    Attributes:
        model: of the arm.
        estimate: the result.
        stated: the result with the uncertainty that is reported, as of elastic gears.
        evidence: errors on held-out motion.
        held_out: this motion; empty if nothing was held out.
        consistent: parameters (p,) of possible bodies, as files for simulators have them; None:
            there are none.
        lower: joint limits (n,) [rad or m].
        upper: the same.
    """

    model: RobotModel
    estimate: Estimate
    stated: Estimate
    evidence: Evidence
    held_out: Sequence[Samples]
    consistent: Array | None
    lower: Array
    upper: Array

    @cached_property
    def residuals(self) -> list[SlowResidual]:
        """What a monitor of contacts sees of the held-out motion."""
        return slow_residuals(self.model, self.estimate.values, self.held_out)

    def thresholds(self) -> tuple[ContactThreshold, ...]:
        """Return thresholds of contacts; force and mass in the middle of the ranges."""
        return contact_thresholds(self.model, self.residuals, 0.5 * (self.lower + self.upper))


def purposes_of(arm: Application, limits: PurposeLimits) -> tuple[Purpose, ...]:
    """Return all purposes, in the order in which they are shown."""
    postures = workspace(arm.lower, arm.upper)
    residuals = arm.residuals
    return (
        feed_forward(arm.evidence, limits),
        gravity_compensation(arm.model, arm.estimate, postures),
        simulation(arm, limits),
        contact_detection(arm.model, residuals, postures, limits),
        change_of_payload(arm.model, residuals, limits),
        single_parameters(arm.stated),
    )


def feed_forward(evidence: Evidence, limits: PurposeLimits) -> Purpose:
    """Return the fraction of the torque that feedback must add on unseen motion."""
    share = evidence.held_out.overall
    if evidence.in_sample or not np.isfinite(share):
        return Purpose.unknown("feed-forward", "nothing held out")
    references = {"none": 1.0}
    worse = False
    for name, error in (
        ("nominal", evidence.nominal),
        ("nominal with friction", evidence.nominal_with_friction),
    ):
        if error is not None:
            references[name] = error.overall
            worse = worse or share > error.overall + Thresholds().nominal
    return Purpose(
        "feed-forward",
        share <= limits.feed_forward and not worse,
        share,
        limits.feed_forward,
        references=references,
    )


def gravity_compensation(model: RobotModel, estimate: Estimate, postures: Array) -> Purpose:
    """Return the error of the gravity torque over dry friction: below one the arm stays.

    Torques from which gravity was removed do not say how large it is.
    """
    if not np.any(model.gravity):
        return Purpose.unknown("gravity", "no gravity")
    error, friction = gravity_error(model, estimate, postures)
    known = friction > 0.0
    ratio = error / np.where(known, friction, 1.0)
    worst = float(ratio[known].max(initial=0.0))
    missing = not known.all()
    good = False if worst > 1.0 else None if missing else True
    return Purpose(
        "gravity",
        good,
        worst if known.any() else None,
        1.0,
        joints=tuple(error.tolist()),
        joint_limits=tuple(np.where(known, friction, 0.0).tolist()),
        missing="no dry friction" if missing else "",
    )


def contact_detection(
    model: RobotModel,
    residuals: Sequence[SlowResidual],
    postures: Array,
    limits: PurposeLimits,
) -> Purpose:
    """Return the force at the flange that a threshold detects which holds without contact.

    Args:
        model: of the arm.
        residuals: slow part of the residual on unseen motion.
        postures: in which forces act (k, n) [rad or m].
        limits: of the purposes.
    """
    if not residuals:
        return Purpose.unknown("contact", "nothing held out", "N")
    found = contact(model, residuals, postures)
    if found is None:
        return Purpose.unknown("contact", "too short", "N")
    return Purpose(
        "contact",
        None if limits.contact is None else found.force <= limits.contact,
        found.force,
        limits.contact,
        "N",
        joints=tuple(found.torque.tolist()),
        references={"period": FALSE_ALARM_PERIOD},
    )


def change_of_payload(
    model: RobotModel, residuals: Sequence[SlowResidual], limits: PurposeLimits
) -> Purpose:
    """Return the smallest mass at the flange that would be seen."""
    if not residuals:
        return Purpose.unknown("payload", "nothing held out", "kg")
    mass = seen_mass(model, residuals)
    if mass is None:
        return Purpose.unknown("payload", "too short", "kg")
    good = None if limits.payload is None else mass <= limits.payload
    return Purpose(
        "payload", good, mass, limits.payload, "kg", references={"period": FALSE_ALARM_PERIOD}
    )


def simulation(arm: Application, limits: PurposeLimits) -> Purpose:
    """Return how far a simulated flange is from its measured path after `HORIZON_SECONDS`."""
    if not arm.held_out:
        return Purpose.unknown("simulation", "nothing held out", "m")
    if arm.consistent is None:
        return Purpose.unknown("simulation", "not possible", "m")
    try:
        error = flange_error(arm.model, arm.consistent, arm.held_out)
    except IdentificationError:
        return Purpose.unknown("simulation", "not possible", "m")
    if error is None:
        return Purpose.unknown("simulation", "too short", "m")
    good = error <= limits.distance
    references = {"horizon": HORIZON_SECONDS, **_largest(arm)}
    return Purpose("simulation", good, error, limits.distance, "m", references=references)


def _largest(arm: Application) -> dict[str, float]:
    """Return the largest speed and acceleration of a joint that turns, in the held-out motion."""
    turns = np.array(arm.model.chain.revolute)
    use = [run.usable & turns for run in arm.held_out]
    if not any(each.any() for each in use):
        return {}

    def largest(of_runs: Iterable[Array]) -> float:
        pairs = zip(of_runs, use, strict=True)
        return max(float(np.abs(values).max(where=each, initial=0.0)) for values, each in pairs)

    return {
        "speed": largest(run.motion.velocity for run in arm.held_out),
        "acceleration": largest(run.motion.acceleration for run in arm.held_out),
    }


def single_parameters(estimate: Estimate) -> Purpose:
    """Return how many parameters are known, roughly, and not."""
    known = estimate.known
    references = {"roughly": float(known.count("roughly")), "not": float(known.count("no"))}
    return Purpose("parameters", None, float(known.count("yes")), references=references)
