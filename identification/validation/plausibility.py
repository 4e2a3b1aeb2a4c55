"""Signs of estimated parameters that are physically impossible, as far as they are significant."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.factor.factor import Estimate, Factor
from identification.model.friction import COULOMB
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

_SIGMAS: Final = 3.0  # standard deviations of a significant wrong sign
# Masses, rotor inertias, moments of inertia about an axis.
_NEVER_NEGATIVE: Final = re.compile(r"m\d+|I\d+(m|xx|yy|zz)")


class Implausible(NamedTuple):
    """Messages on wrong signs of an estimate."""

    impossible: tuple[str, ...]  # wrong signs with a torque above the prediction error
    doubtful: tuple[str, ...]  # wrong signs with a smaller torque


def implausibilities(
    model: RobotModel,
    estimate: Estimate,
    motion: Factor,
    error_rms: Array,
    *,
    speed: Array,
) -> Implausible:
    """Return messages on what is physically impossible in an estimate.

    The torque of wrong signs on a `motion` is compared with the error of its prediction (n,);
    friction is evaluated up to the highest speeds (n,).
    """
    impossible: list[str] = []
    doubtful: list[str] = []
    for words, part in _wrong_signs(model, estimate, speed):
        own = np.where(part, estimate.values, 0.0)
        squares = np.einsum("i,jik,k->j", own, motion.gram[:, :-1, :-1], own)
        torque = np.sqrt(np.maximum(squares, 0.0) / np.maximum(motion.samples, 1))
        (impossible if np.any(torque > error_rms) else doubtful).append(words)
    return Implausible(tuple(impossible), tuple(doubtful))


def _is_negative(estimate: Estimate, direction: Array) -> bool:
    """Return whether direction · parameters is significantly below zero."""
    known = np.isfinite(np.diag(estimate.covariance))
    if np.any(direction[~known]):
        return False
    part = direction[known]
    variance = float(part @ estimate.covariance[np.ix_(known, known)] @ part)
    return float(direction @ estimate.values) < -_SIGMAS * float(np.sqrt(variance))


def _wrong_signs(
    model: RobotModel, estimate: Estimate, speed: Array
) -> Iterator[tuple[str, NDArray[np.bool_]]]:
    """Yield messages on wrong signs, with the parameters (p,) that cause them."""
    values, first, count = estimate.values, model.base.rank, len(estimate.values)
    for joint, (name, law) in enumerate(zip(model.joint_names, model.friction.laws, strict=True)):
        one = speed[joint : joint + 1]
        top, coulomb = np.zeros((2, count))
        for k, (_, term, owner, motor, _) in enumerate(model.friction.terms, start=first):
            if owner == joint and not motor and term.is_friction:
                top[k] = term.column(one, law.sign(one))[0]
                coulomb[k] = term == COULOMB
        if _is_negative(estimate, coulomb):
            words = (
                f"Coulomb friction of {name} is negative ({coulomb @ values:.3g}): a torque or a"
                " direction has the wrong sign"
            )
            yield words, top != 0.0
        elif _is_negative(estimate, top - 0.5 * coulomb):
            words = (
                f"friction of {name} is {top @ values:.3g} at its top speed of {speed[joint]:.3g},"
                f" less than half of its Coulomb friction {coulomb @ values:.3g}"
            )
            yield words, top != 0.0
    alone = {  # names of single parameters
        k: f"friction {term.name} of motor {term.owner + 1}"
        for k, term in enumerate(model.friction.terms, start=first)
        if term.motor
    }
    for k, (name, row) in enumerate(zip(model.base.names, model.base.grouping, strict=True)):
        if np.count_nonzero(row) <= 1 and _NEVER_NEGATIVE.fullmatch(name):
            alone[k] = name
    for k, name in alone.items():
        direction = np.arange(count) == k
        if _is_negative(estimate, direction.astype(np.float64)):
            figures = f"{values[k]:.3g} ± {estimate.std[k]:.2g} {estimate.units[k]}"
            yield f"{name} is negative: {figures}", direction


def inertia_matrices(model: RobotModel, values: Array, position: Array) -> Array:
    """Return inertia matrices (k, n, n) with rotors, of parameters (p,) at positions (k, n)."""
    still = np.zeros_like(position)
    rest = model.torque(values, position, still, still)
    columns = [
        model.torque(values, position, still, still + axis) - rest
        for axis in np.eye(model.n_joints)
    ]
    return np.stack(columns, axis=2)
