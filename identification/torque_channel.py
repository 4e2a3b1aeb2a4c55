"""What the torque channel of a log has been through before it was logged."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from identification.estimation import estimate
from identification.model import RobotModel
from identification.noise import difference_variance
from identification.preprocessing import Preprocessing, prepare
from identification.recording import Recording

Array = NDArray[np.float64]

LOWEST_BANDWIDTH: Final = 0.5  # Hz; below it nothing of a robot's motion would be left
# A channel whose white noise is less than this share of what the model leaves over has been
# filtered: unfiltered torque always has noise of the size of the residual's fast part.
_NOISELESS: Final = 0.02
# The low-pass has to earn its place: residuals smaller by this share, on average over joints.
_WORTHWHILE: Final = 0.05
_COARSE: Final = 10


def find_torque_bandwidth(
    recording: Recording,
    model: RobotModel,
    *,
    noise_variance: Array | None = None,
    options: Preprocessing = Preprocessing(),  # noqa: B008 - frozen
) -> float | None:
    """Bandwidth [Hz] of the low-pass the torque has come through, None if it seems to be none.

    Many controllers log a smoothed effort: Coulomb friction, a step in the regressor, is then a
    slope in the torque, and a fit of one to the other is wrong at every reversal. Sought is the
    bandwidth with which the regressor fits the recording best (least mean log residual over the
    joints). Use only recordings that the fit may use.

    Args:
        recording: checked, with torque.
        model: the robot.
        noise_variance: of the positions (n,), see :func:`identification.preprocessing.smooth`.
        options: the other settings.
    """
    assert recording.torque is not None
    # One set of rows for all: the ends that the narrowest filter knows badly do not count.
    narrowest = replace(options, torque_bandwidth=LOWEST_BANDWIDTH)
    samples = prepare(recording, model, noise_variance=noise_variance, options=narrowest)

    def log_residuals(bandwidth: float | None) -> Array:
        """Log of the residual's standard deviation per joint (n,) that moves."""
        each = None if bandwidth is None else np.full(model.n_joints, bandwidth)
        factor = replace(samples, torque_bandwidth=each).factor(model)
        noise = estimate(model, factor).noise_std
        return np.asarray(np.log(noise[np.isfinite(noise)]))

    unfiltered = log_residuals(None)
    white = difference_variance(recording.time, recording.torque)
    if np.any(np.sqrt(white) > _NOISELESS * np.exp(unfiltered)):
        return None

    def misfit(log_bandwidth: float) -> float:
        return float(np.mean(log_residuals(float(np.exp(log_bandwidth)))))

    highest = 0.25 / float(np.median(np.diff(recording.time)))
    grid = np.linspace(np.log(LOWEST_BANDWIDTH), np.log(highest), _COARSE)
    coarse = [misfit(point) for point in grid]
    best = int(np.argmin(coarse))
    around = grid[max(best - 1, 0)], grid[min(best + 1, _COARSE - 1)]
    fine = scipy.optimize.minimize_scalar(
        misfit, bounds=around, method="bounded", options={"xatol": 0.02}
    )
    if fine.fun > float(np.mean(unfiltered)) + np.log(1.0 - _WORTHWHILE):
        return None
    return float(np.exp(fine.x))
