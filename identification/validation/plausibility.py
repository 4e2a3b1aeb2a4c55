"""Whether estimated parameters can belong to a machine at all.

Signs that nature does not make: friction that drives, negative masses, an arm that could be
accelerated at a gain of energy. Each is asked for with the estimate's own uncertainty, so that
a parameter that is merely not known is no offence.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.factor.factor import Estimate, Factor
from identification.model.friction import Coulomb
from identification.model.robot import RobotModel

Array = NDArray[np.float64]

# More standard deviations for what was searched for among many directions and postures.
_SEARCHED = 2.0

# Never negative, whatever the axes: masses, rotor inertias, moments of inertia about an axis.
_NEVER_NEGATIVE = re.compile(r"m\d+|I\d+(m|xx|yy|zz)")


class Implausible(NamedTuple):
    """What is wrong with the signs of an estimate, in words.

    Attributes:
        impossible: a wrong sign that the predictions rest on.
        doubtful: a wrong sign whose whole torque is less than the error of the prediction.
    """

    impossible: tuple[str, ...]
    doubtful: tuple[str, ...]


class _Offence(NamedTuple):
    words: str
    torque: Array  # (n,) RMS torque of the offending terms


def implausibilities(
    model: RobotModel,
    estimate: Estimate,
    motion: Factor,
    error_rms: Array,
    *,
    position: Array,
    speed: Array,
    sigmas: float = 3.0,
) -> Implausible:
    """Say in words what about an estimate is physically impossible.

    Args:
        model: the robot.
        estimate: of the model's parameters.
        motion: on which the model predicts, to weigh offences by their torque.
        error_rms: of those predictions (n,).
        position: postures to look at the inertia matrix in (k, n).
        speed: highest measured speed per joint (n,): friction is looked at up to there.
        sigmas: standard deviations beyond which a wrong sign counts.
    """
    offences = [
        *_friction(model, estimate, motion, speed, sigmas),
        *_inertial(model, estimate, motion, sigmas),
    ]
    matters = [bool(np.any(offence.torque > error_rms)) for offence in offences]
    return Implausible(
        impossible=(
            *(o.words for o, serious in zip(offences, matters, strict=True) if serious),
            *_inertia_matrix(model, estimate, position, sigmas),
        ),
        doubtful=tuple(
            o.words for o, serious in zip(offences, matters, strict=True) if not serious
        ),
    )


def _is_negative(estimate: Estimate, direction: Array, sigmas: float) -> bool:
    """Whether direction · parameters is below zero significantly."""
    known = np.isfinite(np.diag(estimate.covariance))
    if np.any(direction[~known]):
        return False
    part = direction[known]
    variance = float(part @ estimate.covariance[np.ix_(known, known)] @ part)
    return float(direction @ estimate.values) < -sigmas * float(np.sqrt(variance))


def _torque_rms(motion: Factor, values: Array) -> Array:
    """RMS torque (n,) that parameter values (p,) make on a motion."""
    squares = np.einsum("i,jik,k->j", values, motion.gram[:, :-1, :-1], values)
    return np.asarray(np.sqrt(np.maximum(squares, 0.0) / np.maximum(motion.samples, 1)))


def _friction(
    model: RobotModel, estimate: Estimate, motion: Factor, speed: Array, sigmas: float
) -> list[_Offence]:
    """Coulomb friction below zero, and friction at top speed below half of Coulomb's.

    Friction may fall with speed (Stribeck) before it rises, by a quarter perhaps; at top speed
    that is over, and less than half is a viscous coefficient with the wrong sign.
    """
    found = []
    first = model.base.rank
    for joint, (name, law) in enumerate(zip(model.joint_names, model.friction.laws, strict=True)):
        one = speed[joint : joint + 1]
        top, coulomb = np.zeros((2, len(estimate.values)))
        for k, (_, term, owner, motor, _) in enumerate(model.friction.terms, start=first):
            if motor or owner != joint or not term.is_friction:
                continue
            top[k] = term.column(one, law.sign(one))[0]
            coulomb[k] = isinstance(term, Coulomb)
        torque = _torque_rms(motion, np.where(top != 0.0, estimate.values, 0.0))
        if _is_negative(estimate, coulomb, sigmas):
            words = (
                f"Coulomb friction of {name} is negative ({coulomb @ estimate.values:.3g}): a"
                " torque or a direction has the wrong sign"
            )
            found.append(_Offence(words, torque))
        elif _is_negative(estimate, top - 0.5 * coulomb, sigmas):
            words = (
                f"friction of {name} is {top @ estimate.values:.3g} at its top speed of"
                f" {speed[joint]:.3g}, less than half of its Coulomb friction"
                f" {coulomb @ estimate.values:.3g}"
            )
            found.append(_Offence(words, torque))
    return found + _motor_friction(model, estimate, motion, sigmas)


def _motor_friction(
    model: RobotModel, estimate: Estimate, motion: Factor, sigmas: float
) -> list[_Offence]:
    """Coulomb or viscous friction below zero of a motor that several joints turn."""
    found = []
    for k, term in enumerate(model.friction.terms, start=model.base.rank):
        if not term.motor:
            continue
        direction = np.zeros(len(estimate.values))
        direction[k] = 1.0
        if _is_negative(estimate, direction, sigmas):
            words = (
                f"friction {term.name} of motor {term.owner + 1} is negative:"
                f" {estimate.values[k]:.3g} ± {estimate.std[k]:.2g} {term.unit}; a coupling ratio"
                " or a direction may have the wrong sign"
            )
            found.append(_Offence(words, _torque_rms(motion, direction * estimate.values)))
    return found


def _inertial(
    model: RobotModel, estimate: Estimate, motion: Factor, sigmas: float
) -> list[_Offence]:
    """Base parameters that stand for one standard parameter alone and have its wrong sign."""
    found = []
    for index, row in enumerate(model.base.grouping):
        name = model.base.names[index]
        if np.count_nonzero(row) > 1 or not _NEVER_NEGATIVE.fullmatch(name):
            continue
        direction = np.zeros(len(estimate.values))
        direction[index] = 1.0
        if _is_negative(estimate, direction, sigmas):
            words = (
                f"{name} is negative: {estimate.values[index]:.3g} ± {estimate.std[index]:.2g}"
                f" {estimate.units[index]}"
            )
            found.append(_Offence(words, _torque_rms(motion, direction * estimate.values)))
    return found


def _inertia_matrix(
    model: RobotModel, estimate: Estimate, position: Array, sigmas: float
) -> list[str]:
    """A posture in which the inertia matrix has a negative direction."""
    columns = _inertia_columns(model, position)  # (k, n, n, p)
    matrices = columns @ estimate.values
    matrices = 0.5 * (matrices + matrices.transpose(0, 2, 1))
    eigenvalues, vectors = np.linalg.eigh(matrices)
    worst = int(np.argmin(eigenvalues[:, 0]))
    along = vectors[worst, :, 0]
    direction = np.einsum("i,ijp,j->p", along, columns[worst], along)
    if not _is_negative(estimate, direction, sigmas + _SEARCHED):
        return []
    joint = model.joint_names[int(np.argmax(np.abs(along)))]
    return [
        f"the inertia seen by {joint} is negative ({eigenvalues[worst, 0]:.3g}) in a posture of"
        " the unseen motion: a torque or a direction has the wrong sign"
    ]


def _inertia_columns(model: RobotModel, position: Array) -> Array:
    """Inertia matrix as a linear map of the parameters: (k, n, n, p)."""
    k, n = position.shape
    zero = np.zeros((k, n))
    p = model.n_parameters
    gravity = model.regressor(position, zero, zero).dense(p)
    columns = np.empty((k, n, n, p))
    for joint in range(n):
        unit = zero.copy()
        unit[:, joint] = 1.0
        columns[:, :, joint] = model.regressor(position, zero, unit).dense(p) - gravity
    return columns
