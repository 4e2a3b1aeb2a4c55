"""Signs of an estimate that are physically impossible, as far as they are significant."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor
from identification.hypotheses.little_torque import little_torque
from identification.model.friction import COULOMB
from identification.model.robot import RobotModel

SIGMAS: Final = 3.0  # standard deviations of a significant wrong sign or change
# Masses, rotor inertias, moments of inertia about an axis.
_NEVER_NEGATIVE: Final = re.compile(r"m\d+|I\d+(m|xx|yy|zz)")


class Implausible(NamedTuple):
    """Messages on wrong signs of an estimate."""

    impossible: tuple[str, ...]  # wrong signs with a torque above the prediction error
    doubtful: tuple[str, ...]  # wrong signs with a smaller torque
    added: tuple[str, ...] = ()  # friction that falls by a term that nobody stated


def implausibilities(
    model: RobotModel,
    estimate: Estimate,
    motion: Factor,
    error_rms: Array,
    *,
    speed: Array,
    added: Collection[str] = (),
) -> Implausible:
    """Return messages on what is physically impossible in an estimate.

    The torque of wrong signs on a `motion` is compared with the error of its prediction (n,), of
    which it must be a multiple on axes of little torque; friction is evaluated up to the highest
    speeds (n,). Terms of friction of `added` symbols were
    chosen, not stated: they follow the friction within the fitted speeds and are no reason against
    a model.
    """
    impossible: list[str] = []
    doubtful: list[str] = []
    chosen: list[str] = []
    torque_rms = np.sqrt(motion.gram[:, -1, -1] / np.maximum(motion.samples, 1))
    little = little_torque(torque_rms, ~model.chain.revolute)
    limit = np.where(little, _FAR_ABOVE, 1.0) * error_rms
    for message, part, by_added in _wrong_signs(model, estimate, speed, added):
        if by_added:
            chosen.append(message)
            continue
        part_values = np.where(part, estimate.values, 0.0)
        squares = np.einsum("i,jik,k->j", part_values, motion.gram[:, :-1, :-1], part_values)
        torque = np.sqrt(np.maximum(squares, 0.0) / np.maximum(motion.samples, 1))
        (impossible if np.any(torque > limit) else doubtful).append(message)
    return Implausible(tuple(impossible), tuple(doubtful), tuple(chosen))


def _is_negative(estimate: Estimate, direction: Array) -> bool:
    """Return whether direction · parameters is significantly below zero."""
    determined = np.isfinite(np.diag(estimate.covariance))
    if np.any(direction[~determined]):
        return False
    part = direction[determined]
    variance = float(part @ estimate.covariance[np.ix_(determined, determined)] @ part)
    return float(direction @ estimate.values) < -SIGMAS * float(np.sqrt(variance))


def _wrong_signs(
    model: RobotModel, estimate: Estimate, speed: Array, added: Collection[str] = ()
) -> Iterator[tuple[str, NDArray[np.bool_], bool]]:
    """Yield messages on wrong signs, the parameters (p,) that cause them, and if by added terms."""
    values = estimate.values
    first = model.base.rank
    count = len(estimate.values)
    for joint, (name, law) in enumerate(zip(model.joint_names, model.friction.laws, strict=True)):
        top_speed = speed[joint : joint + 1]
        top, coulomb, stated = np.zeros((3, count))
        for k, (_, term, owner, motor, _) in enumerate(model.friction.terms, start=first):
            if owner == joint and not motor and term.is_friction:
                top[k] = term.column(top_speed, law.sign(top_speed))[0]
                coulomb[k] = term == COULOMB
                stated[k] = term.symbol not in added
        if _is_negative(estimate, coulomb):
            message = (
                f"Coulomb friction of {name} is negative ({coulomb @ values:.3g}): a torque or a"
                " direction has the wrong sign"
            )
            yield message, top != 0.0, False
        elif _is_negative(estimate, top - 0.5 * coulomb):
            by_added = not _is_negative(estimate, stated * top - 0.5 * coulomb)
            message = (
                f"friction of {name} is {top @ values:.3g} at its top speed of {speed[joint]:.3g},"
                f" less than half of its Coulomb friction {coulomb @ values:.3g}"
            )
            if by_added:
                message += ", by a friction term that was chosen by inner prediction"
            yield message, top != 0.0, by_added
    alone = {  # names of single parameters
        k: f"friction {term.name} of {'motor' if term.motor else 'joint'} {term.owner + 1}"
        for k, term in enumerate(model.friction.terms, start=first)
        if term.motor or term.term.of_load
    }
    for k, (name, row) in enumerate(zip(model.base.names, model.base.grouping, strict=True)):
        if np.count_nonzero(row) <= 1 and _NEVER_NEGATIVE.fullmatch(name):
            alone[k] = name
    for k, name in alone.items():
        direction = np.arange(count) == k
        if _is_negative(estimate, direction.astype(np.float64)):
            figures = f"{values[k]:.3g} ± {estimate.std[k]:.2g} {estimate.units[k]}"
            yield f"{name} is negative: {figures}", direction, False


class TopSpeedFriction(NamedTuple):
    """Friction of n joints at their top speed, negative if it drives the joint."""

    torque: Array  # (n,) [N·m or N]
    std: Array  # (n,), infinite if undetermined or without friction terms

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the sign of each is significant (n,)."""
        return np.asarray(np.abs(self.torque) > SIGMAS * self.std)

    @property
    def all_driving(self) -> NDArray[np.bool_]:
        """Joints with known friction (n,) if it drives all of them, most of the arm; else none."""
        determined = self.known
        most = np.count_nonzero(determined) >= max(2, 0.5 * len(determined))
        return determined & bool(most and np.all(self.torque[determined] < 0.0))

    @property
    def described(self) -> NDArray[np.object_]:
        """Torques with their standard deviations as text (n,)."""
        pairs = zip(self.torque, self.std, strict=True)
        return np.array([f"{torque:.3g} ± {2.0 * std:.2g}" for torque, std in pairs], dtype=object)


def dissipation_of(model: RobotModel, estimate: Estimate, speed: Array) -> TopSpeedFriction:
    """Return the friction of each joint at its highest speed (n,) [rad/s or m/s]."""
    std = np.full(model.n_joints, np.inf)
    determined = np.isfinite(np.diag(estimate.covariance))
    covariance = np.where(np.outer(determined, determined), estimate.covariance, 0.0)
    rows = friction_at(model, speed)
    for joint, row in enumerate(rows):
        if row.any() and not np.any(row[~determined]):
            std[joint] = float(np.sqrt(row @ covariance @ row))
    return TopSpeedFriction(rows @ estimate.values, std)


def friction_at(model: RobotModel, speed: Array) -> Array:
    """Return the columns (n, p) of each joint's friction at its speed (n,) [rad/s or m/s]."""
    rows = np.zeros((model.n_joints, model.n_parameters))
    for k, (_, term, joint, motor, _) in enumerate(model.friction.terms, start=model.base.rank):
        if not motor and term.is_friction:
            along = speed[joint : joint + 1]
            rows[joint, k] = term.column(along, model.friction.laws[joint].sign(along))[0]
    return rows


_FAR_ABOVE: Final = 4.0  # errors of an axis of little torque; its error is mostly friction
