"""Signs of an estimate that are physically impossible and significant."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Mapping
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.arrays import Array
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.factor.estimate import Estimate
from identification.factor.factor import Factor
from identification.hypotheses.little_torque import little_torque
from identification.model.friction import COULOMB
from identification.model.robot import RobotModel

# Masses, rotor inertias, moments of inertia about an axis.
_NEVER_NEGATIVE: Final = re.compile(r"m\d+|I\d+(m|xx|yy|zz)")


SignKind = Literal[
    "negative Coulomb friction",
    "little friction at speed",
    "little friction at speed by a chosen term",
    "negative parameter",
]


class WrongSign(NamedTuple):
    """One physically impossible sign.

    Attributes:
        kind: what is wrong.
        name: of the joint or the parameter.
        figures: `value`; of friction at speed also `speed` and `coulomb`, of a parameter `std`.
        unit: of a parameter.
        joints: that it is of, if it is friction of one.
    """

    kind: SignKind
    name: str
    figures: Mapping[str, float]
    unit: str = ""
    joints: tuple[int, ...] = ()


class Implausible(NamedTuple):
    """Wrong signs of an estimate."""

    impossible: tuple[WrongSign, ...]  # with a torque above the prediction error
    doubtful: tuple[WrongSign, ...]  # with a smaller torque
    added: tuple[WrongSign, ...] = ()  # friction that falls because of a chosen term


def implausibilities(
    model: RobotModel,
    estimate: Estimate,
    motion: Factor,
    error_rms: Array,
    *,
    speed: Array,
    added: Collection[str] = (),
) -> Implausible:
    """Return what is physically impossible in an estimate.

    Args:
        model: of the arm.
        estimate: of its parameters.
        motion: factor of a motion, on which the torque of wrong signs is compared with an error.
        error_rms: of the prediction of that motion (n,); on axes of little torque, the torque must
            be a multiple of it.
        speed: highest of each joint (n,), up to which friction is evaluated.
        added: symbols of friction terms that were chosen, not stated: they follow the friction
            within the fitted speeds and are no reason against a model.
    """
    impossible: list[WrongSign] = []
    doubtful: list[WrongSign] = []
    chosen: list[WrongSign] = []
    torque_rms = np.sqrt(motion.gram[:, -1, -1] / np.maximum(motion.samples, 1))
    little = little_torque(torque_rms, ~model.chain.revolute)
    limit = np.where(little, _LITTLE_TORQUE_FACTOR, 1.0) * error_rms
    for sign, causing in _wrong_signs(model, estimate, speed, added):
        if sign.kind == "little friction at speed by a chosen term":
            chosen.append(sign)
            continue
        part_values = np.where(causing, estimate.values, 0.0)
        squares = np.einsum("i,jik,k->j", part_values, motion.gram[:, :-1, :-1], part_values)
        torque = np.sqrt(np.maximum(squares, 0.0) / np.maximum(motion.samples, 1))
        (impossible if np.any(torque > limit) else doubtful).append(sign)
    return Implausible(tuple(impossible), tuple(doubtful), tuple(chosen))


def _is_negative(estimate: Estimate, direction: Array) -> bool:
    """Return whether direction · parameters is significantly below zero."""
    determined = np.isfinite(np.diag(estimate.covariance))
    if np.any(direction[~determined]):
        return False
    part = direction[determined]
    variance = float(part @ estimate.covariance[np.ix_(determined, determined)] @ part)
    return float(direction @ estimate.values) < -SIGNIFICANT_SIGMAS * float(np.sqrt(variance))


def _wrong_signs(
    model: RobotModel, estimate: Estimate, speed: Array, added: Collection[str] = ()
) -> Iterator[tuple[WrongSign, NDArray[np.bool_]]]:
    """Yield wrong signs, with the parameters (p,) that cause them."""
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
            negative = {"value": float(coulomb @ values)}
            yield (
                WrongSign("negative Coulomb friction", name, negative, joints=(joint,)),
                top != 0.0,
            )
        elif _is_negative(estimate, top - 0.5 * coulomb):
            by_added = not _is_negative(estimate, stated * top - 0.5 * coulomb)
            figures = {
                "value": float(top @ values),
                "speed": float(speed[joint]),
                "coulomb": float(coulomb @ values),
            }
            kind: SignKind = "little friction at speed"
            if by_added:
                kind = "little friction at speed by a chosen term"
            yield WrongSign(kind, name, figures, joints=(joint,)), top != 0.0
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
            figures = {"value": float(values[k]), "std": float(estimate.std[k])}
            yield WrongSign("negative parameter", name, figures, estimate.units[k]), direction


class TopSpeedFriction(NamedTuple):
    """Friction of n joints at their top speed, negative if it drives the joint."""

    torque: Array  # (n,) [N·m or N]
    std: Array  # (n,), infinite if undetermined or without friction terms

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the sign of each is significant (n,)."""
        return np.asarray(np.abs(self.torque) > SIGNIFICANT_SIGMAS * self.std)

    @property
    def all_driving(self) -> NDArray[np.bool_]:
        """Joints with known friction (n,) if it drives all of them, most of the arm; else none."""
        determined = self.known
        most = np.count_nonzero(determined) >= max(2, 0.5 * len(determined))
        return determined & bool(most and np.all(self.torque[determined] < 0.0))


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


# errors of an axis of little torque; its error is mostly friction
_LITTLE_TORQUE_FACTOR: Final = 4.0
