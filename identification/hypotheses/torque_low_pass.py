"""A low-pass of the recorded torque, against what resembles one."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Final

from identification.estimators.torque_channel import possible_low_passes
from identification.hypotheses.scores import (
    SEPARATE_SIGMAS,
    SURE_SIGMAS,
    Score,
    compare,
    score_of,
)
from identification.model.robot import RobotModel
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, Smoothed, prepare

_REVERSAL_SPEEDS: Final = (0.02, 0.08, 0.3)
"""Speeds of ``tanh(v / speed)`` that are tried first, rad/s or m/s."""
_REVERSAL_FACTOR: Final = 2.0
"""Of the best of these, to the next two."""


@dataclass(frozen=True, eq=False)
class TorqueLowPass:
    """A low-pass that predicts the torque of unseen parts better than the torque as recorded.

    Attributes:
        settings: of the preparation, with the low-pass.
        confirmed: certainly so, and better than a delay by its lag, and than dry friction that
            reverses smoothly, both of which resemble it.
    """

    settings: Preprocessing
    confirmed: bool


def torque_low_pass(
    recording: Recording, model: RobotModel, options: Preprocessing
) -> TorqueLowPass | None:
    """Return the low-pass that the recorded torque passed through; None if there seems to be none.

    A gain that falls with the frequency shows one, but so does what the model leaves out. So each
    candidate has to predict blocks that it was not fitted to.

    Args:
        recording: with torque.
        model: of the arm, with its law of friction.
        options: of the preparation without a low-pass.

    Raises:
        IdentificationError: the recording does not contain enough motion.
    """
    candidates = possible_low_passes(recording, model, options=options)
    if not candidates:
        return None
    motions: dict[Preprocessing, Smoothed] = {}

    def score(options: Preprocessing, model: RobotModel = model) -> Score:
        return score_of(model, prepare(recording, model, options=options, motions=motions))

    scores = [score(how) for how in candidates]
    best = min(range(len(scores)), key=lambda index: scores[index].overall)
    settings, filtered = candidates[best], scores[best]
    as_recorded = compare(filtered, score(options), model)
    if not (as_recorded.ratio < 1.0 and as_recorded.sigmas < -SEPARATE_SIGMAS):
        return None
    rivals = (compare(filtered, rival, model) for rival in _rivals(score, model, settings))
    confirmed = as_recorded.sigmas < -SURE_SIGMAS and all(
        rival.ratio < 1.0 and rival.sigmas < -SEPARATE_SIGMAS for rival in rivals
    )
    return TorqueLowPass(settings, confirmed)


def _rivals(
    score: Callable[..., Score], model: RobotModel, settings: Preprocessing
) -> Iterator[Score]:
    """Yield the scores of the lag alone, and of smooth reversals.

    Args:
        score: of settings and, where it is not that of the arm, a model.
        model: of the arm.
        settings: with the low-pass.
    """
    shape, bandwidth = settings.torque_shape, settings.torque_bandwidth
    assert bandwidth is not None
    unfiltered = replace(settings, torque_bandwidth=None)
    if shape.causal:
        late = settings.torque_delay + shape.lag(bandwidth)
        yield score(replace(unfiltered, torque_delay=late))

    def reversing(speed: float) -> Score:
        return score(unfiltered, model.with_friction(tanh=speed))

    scores = {speed: reversing(speed) for speed in _REVERSAL_SPEEDS}
    best = min(scores, key=lambda speed: scores[speed].overall)
    for speed in (best / _REVERSAL_FACTOR, best * _REVERSAL_FACTOR):
        scores[speed] = reversing(speed)
    yield min(scores.values(), key=lambda score: score.overall)
