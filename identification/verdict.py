"""Is the result good? One sentence, and the reasons where it is not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.estimation import Estimate
from identification.model import RobotModel
from identification.plausibility import implausibilities
from identification.preprocessing import Samples
from identification.repeatability import Repeatability, repeatability
from identification.repetitions import RepeatedEstimate
from identification.validation import PredictionError, over_all, prediction_error

Array = NDArray[np.float64]

_POSTURES = 40


@dataclass(frozen=True)
class Thresholds:
    """What a good result keeps to. Shares are of the axis's measured torque, both as RMS.

    The figures come from simulated NS 16 campaigns in which one sign was turned (each gear
    ratio, each wrist coupling, each torque constant, each Coulomb and viscous friction) against
    campaigns without a fault, unmodelled effects off and on.

    Attributes:
        overall: relative torque error over all axes. Fits of real arms that people publish with
            pride lie between 4 and 9 %.
        axis: relative torque error of one axis, noise included. Wrist axes of real arms, whose
            torque is mostly friction, reach 20 %; 35 % is not a model of an axis.
        systematic: error of one axis that is slow (below `slow` Hz) and more than the noise
            between repetitions. Right models: 0.7 % without, 2 % with ripple, drifting
            friction and delay. One turned sign: 6 % and more on some axis, even where the total
            error hides it in noise.
        slow: bandwidth in which a rigid arm makes its torque [Hz]; ripple and current noise lie
            above it, every sign error below.
        inconsistency: difference between the torque that one repetition's own estimate and the
            pooled one predict on the training motion. Noise of the size that `axis` allows
            makes 2 %.
        generalisation: error on unseen motion over the error on the training motion, per axis,
            where repetitions cannot say what is noise.
        nominal: overall error over the nominal model's. A model that predicts worse than the
            data sheet is not worth using.
        sigmas: standard deviations that make a wrong sign certain.
    """

    overall: float = 0.12
    axis: float = 0.35
    systematic: float = 0.035
    slow: float = 10.0
    inconsistency: float = 0.10
    generalisation: float = 2.5
    nominal: float = 1.05
    sigmas: float = 3.0


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a verdict is given on.

    Attributes:
        estimate: the result.
        held_out: its error on motion that was not used for fitting.
        training: its error on the motion it was fitted to.
        held_out_slow: as `held_out`, with the error low-passed to `Thresholds.slow`; None where
            there are no repetitions to tell noise from error.
        slow: what repeats and what does not of the low-passed residual; None likewise.
        disagreement: of the repetitions' own estimates with the pooled one, the worst of them,
            as a share of each axis's torque (n,); None without repetitions.
        nominal: error of the nominal (CAD) model on the same unseen motion, None without one.
        implausible: what is physically impossible about the estimate.
    """

    estimate: Estimate
    held_out: PredictionError
    training: PredictionError
    held_out_slow: PredictionError | None = None
    slow: Repeatability | None = None
    disagreement: Array | None = None
    nominal: PredictionError | None = None
    implausible: tuple[str, ...] = ()

    @property
    def systematic(self) -> Array | None:
        """Slow error on unseen motion beyond the noise, as a share of the torque (n,)."""
        if self.held_out_slow is None or self.slow is None:
            return None
        excess = np.maximum(self.held_out_slow.rms**2 - self.slow.noise**2, 0.0)
        return np.asarray(np.sqrt(excess) / self.held_out.torque_rms)


@dataclass(frozen=True)
class Verdict:
    """Answer to "is the result good?".

    Attributes:
        good: whether the model may be used.
        line: one sentence: whether it predicts unseen motion well, and by how much.
        reasons: what is wrong, in words; empty if good.
    """

    good: bool
    line: str
    reasons: tuple[str, ...]


def gather(
    model: RobotModel,
    result: RepeatedEstimate,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    *,
    nominal: Array | None = None,
    thresholds: Thresholds = Thresholds(),
) -> Evidence:
    """Collect the evidence for a verdict; every recording is read two or three times.

    Args:
        model: the robot.
        result: from the training recordings.
        training: repetitions, as many as the result has.
        held_out: motions that were not used for fitting.
        nominal: parameters (p,) of the nominal model.
        thresholds: for the bandwidth and the significance.

    Raises:
        IdentificationError: nothing was held out.
    """
    if not held_out:
        raise IdentificationError("there is no motion left that was not used for fitting")
    values = result.pooled.values
    repeated = len(result.repetitions) > 1
    velocity = np.concatenate([run.motion.velocity for run in held_out])
    position = np.concatenate([run.motion.position for run in held_out])
    return Evidence(
        estimate=result.pooled,
        held_out=over_all(prediction_error(model, values, held_out)),
        training=over_all(prediction_error(model, values, training)),
        held_out_slow=over_all(prediction_error(model, values, held_out, bandwidth=thresholds.slow))
        if repeated
        else None,
        slow=repeatability(model, values, training, thresholds.slow) if repeated else None,
        disagreement=_disagreement(result) if repeated else None,
        nominal=None if nominal is None else over_all(prediction_error(model, nominal, held_out)),
        implausible=implausibilities(
            model,
            result.pooled,
            position[:: max(1, len(position) // _POSTURES)],
            np.abs(velocity).max(axis=0),
            thresholds.sigmas,
        ),
    )


def judge(
    joint_names: Sequence[str], evidence: Evidence, thresholds: Thresholds = Thresholds()
) -> Verdict:
    """Give the verdict.

    Args:
        joint_names: names of the n axes.
        evidence: see :func:`gather`.
        thresholds: what a good result keeps to.
    """
    reasons = (
        *_undetermined(evidence),
        *evidence.implausible,
        *_errors(joint_names, evidence, thresholds),
        *_systematic(joint_names, evidence, thresholds),
        *_inconsistent(joint_names, evidence, thresholds),
        *_nominal(evidence, thresholds),
    )
    error = evidence.held_out
    worst = int(np.argmax(error.relative))
    measure = (
        f"its torque error is {error.overall:.1%} over all axes, {error.relative[worst]:.1%} at"
        f" worst ({joint_names[worst]})"
    )
    systematic = evidence.systematic
    if systematic is not None:
        axis = int(np.argmax(systematic))
        measure += f", of which {systematic[axis]:.1%} at most is systematic ({joint_names[axis]})"
    if reasons:
        line = f"The model must not be relied on: {reasons[0]}; {measure}."
    else:
        line = f"The model predicts unseen motion well: {measure}."
    return Verdict(good=not reasons, line=line, reasons=reasons)


def _disagreement(result: RepeatedEstimate) -> Array:
    gram = result.factor.gram
    differences = np.array([one.values for one in result.repetitions]) - result.pooled.values
    torque = np.einsum("ri,jik,rk->rj", differences, gram[:, :-1, :-1], differences)
    share = np.maximum(torque, 0.0) / np.maximum(gram[:, -1, -1], 1e-300)
    return np.asarray(np.sqrt(share.max(axis=0)))


def _undetermined(evidence: Evidence) -> list[str]:
    names = evidence.estimate.undetermined
    if not names:
        return []
    listed = ", ".join(names[:6]) + (f" and {len(names) - 6} more" if len(names) > 6 else "")
    return [f"the motion does not determine {listed}"]


def _errors(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    found = []
    error = evidence.held_out
    if error.overall > limit.overall:
        found.append(
            f"the torque error on unseen motion is {error.overall:.1%} over all axes, more than"
            f" {limit.overall:.0%}"
        )
    for axis, name in enumerate(names):
        if error.relative[axis] > limit.axis:
            found.append(
                f"the torque error of {name} on unseen motion is {error.relative[axis]:.0%}, more"
                f" than {limit.axis:.0%}"
            )
        if evidence.slow is not None:
            continue
        growth = error.relative[axis] / max(evidence.training.relative[axis], 1e-12)
        if growth > limit.generalisation and error.relative[axis] > limit.systematic:
            found.append(
                f"the torque error of {name} grows {growth:.1f} times from the training motion"
                " to unseen motion"
            )
    return found


def _systematic(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    share = evidence.systematic
    if share is None:
        return []
    return [
        f"{name} has a systematic torque error of {share[axis]:.1%} on unseen motion that noise"
        f" does not explain, more than {limit.systematic:.1%}: look for a wrong sign, coupling or"
        " constant in the drive train, or for dynamics that the model lacks"
        for axis, name in enumerate(names)
        if share[axis] > limit.systematic
    ]


def _inconsistent(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> list[str]:
    share = evidence.disagreement
    if share is None:
        return []
    return [
        f"repetitions disagree: their estimates differ by up to {share[axis]:.0%} of the torque"
        f" of {name}, more than {limit.inconsistency:.0%}"
        for axis, name in enumerate(names)
        if share[axis] > limit.inconsistency
    ]


def _nominal(evidence: Evidence, limit: Thresholds) -> list[str]:
    if evidence.nominal is None:
        return []
    if evidence.held_out.overall <= limit.nominal * evidence.nominal.overall:
        return []
    return [
        f"the nominal model predicts better: {evidence.nominal.overall:.1%} against"
        f" {evidence.held_out.overall:.1%}"
    ]
