"""What a verdict on an estimate is given on: its errors, where they come from, and its signs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.directions import gain_if_turned
from identification.errors import IdentificationError
from identification.estimation import Estimate, total
from identification.factor import Factor
from identification.model import RobotModel
from identification.plausibility import Implausible, implausibilities
from identification.preprocessing import Samples
from identification.repeatability import Repeatability, repeatability
from identification.repetitions import RepeatedEstimate
from identification.validation import PredictionError, over_all, prediction_error, slow_error

Array = NDArray[np.float64]

# Bandwidth in which a rigid arm makes its torque [Hz]; ripple and current noise lie above it,
# every error of sign, coupling or constant below.
SLOW: Final = 10.0
SIGMAS: Final = 3.0
_POSTURES: Final = 40
_PLAUSIBLE: Final = Implausible((), ())


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a verdict is given on.

    Attributes:
        estimate: the result.
        held_out: its error on motion that was not used for fitting.
        training: its error on the motion it was fitted to.
        held_out_slow: as `held_out`, with the error low-passed and apart from a change of
            friction; None where there are no repetitions to tell noise from error.
        friction_change: share by which friction was higher on an unseen motion than estimated,
            of all motions the one with the largest change, per joint (n,); None likewise.
        slow: what repeats and what does not of the low-passed residual; None likewise.
        estimation_noise: standard deviation of the predicted torque on the unseen motion because
            the parameters come from noisy data, from the scatter over the repetitions (n,)
            [N·m or N]; None likewise.
        disagreement: of the repetitions' own estimates with the pooled one, the worst of them,
            as a share of each axis's torque (n,); None without repetitions.
        gain_if_turned: see :func:`identification.directions.gain_if_turned` (n,), None if it was
            not tried.
        nominal: error of the nominal (CAD) model on the same unseen motion, None without one.
        implausible: what is physically impossible about the estimate.
    """

    estimate: Estimate
    held_out: PredictionError
    training: PredictionError
    held_out_slow: PredictionError | None = None
    friction_change: Array | None = None
    slow: Repeatability | None = None
    estimation_noise: Array | None = None
    disagreement: Array | None = None
    gain_if_turned: Array | None = None
    nominal: PredictionError | None = None
    implausible: Implausible = _PLAUSIBLE

    @property
    def systematic(self) -> Array | None:
        """Slow error on unseen motion that no noise explains, as a share of the torque (n,).

        Explained are the torque noise and, up to two standard deviations, what it has done to
        the parameters. NaN for a joint that was not tested.
        """
        if self.held_out_slow is None or self.slow is None or self.estimation_noise is None:
            return None
        explained = self.slow.noise**2 + (2.0 * self.estimation_noise) ** 2
        excess = np.maximum(self.held_out_slow.rms**2 - explained, 0.0)
        tested = self.held_out.rows > 0
        return np.where(
            tested, np.sqrt(excess) / np.where(tested, self.held_out.torque_rms, 1), np.nan
        )


def gather(
    model: RobotModel,
    result: RepeatedEstimate,
    training: Sequence[Samples],
    held_out: Sequence[Samples],
    *,
    same_motion: bool = True,
    nominal: Array | None = None,
    slow: float = SLOW,
    sigmas: float = SIGMAS,
) -> Evidence:
    """Collect the evidence for a verdict; every recording is read two or three times.

    Args:
        model: the robot.
        result: from the training recordings.
        training: as many recordings as the result has.
        same_motion: whether these are repetitions of one motion; only then can what repeats be
            told from noise.
        held_out: motions that were not used for fitting.
        nominal: parameters (p,) of the nominal model.
        slow: bandwidth in which systematic errors are looked for [Hz].
        sigmas: standard deviations that make a wrong sign certain.

    Raises:
        IdentificationError: nothing was held out.
    """
    if not held_out:
        raise IdentificationError("there is no motion left that was not used for fitting")
    values = result.pooled.values
    repeated = same_motion and len(result.repetitions) > 1
    velocity = np.concatenate([run.motion.velocity for run in held_out])
    position = np.concatenate([run.motion.position for run in held_out])
    unseen = total([run.factor(model) for run in held_out])
    error = over_all(prediction_error(model, values, held_out))
    slow_errors = [slow_error(model, values, run, slow) for run in held_out if repeated]
    return Evidence(
        estimate=result.pooled,
        held_out=error,
        training=over_all(prediction_error(model, values, training)),
        held_out_slow=over_all(one.error for one in slow_errors) if repeated else None,
        friction_change=_largest([one.friction_change for one in slow_errors]),
        slow=repeatability(model, values, training, slow) if repeated else None,
        estimation_noise=_estimation_noise(result, unseen) if repeated else None,
        disagreement=_disagreement(result) if repeated else None,
        gain_if_turned=gain_if_turned(model, training, held_out, slow),
        nominal=None if nominal is None else over_all(prediction_error(model, nominal, held_out)),
        implausible=implausibilities(
            model,
            result.pooled,
            unseen,
            error.rms,
            position=position[:: max(1, len(position) // _POSTURES)],
            speed=np.abs(velocity).max(axis=0),
            sigmas=sigmas,
        ),
    )


def _largest(changes: list[Array]) -> Array | None:
    """Of several vectors (n,), for each entry the one of largest magnitude; None of none."""
    if not changes:
        return None
    stacked = np.array(changes)
    return np.asarray(stacked[np.abs(stacked).argmax(axis=0), np.arange(stacked.shape[1])])


def _disagreement(result: RepeatedEstimate) -> Array:
    gram = result.factor.gram
    differences = np.array([one.values for one in result.repetitions]) - result.pooled.values
    torque = np.einsum("ri,jik,rk->rj", differences, gram[:, :-1, :-1], differences)
    share = np.maximum(torque, 0.0) / np.maximum(gram[:, -1, -1], 1e-300)
    return np.asarray(np.sqrt(share.max(axis=0)))


def _estimation_noise(result: RepeatedEstimate, held_out: Factor) -> Array:
    """Standard deviation of the pooled estimate's predictions, by the scatter of R estimates."""
    repetitions = len(result.repetitions)
    values = np.array([one.values for one in result.repetitions])
    differences = values - values.mean(axis=0)
    torque = np.einsum("ri,jik,rk->j", differences, held_out.gram[:, :-1, :-1], differences)
    variance = torque / (repetitions * (repetitions - 1)) / np.maximum(held_out.samples, 1)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))
