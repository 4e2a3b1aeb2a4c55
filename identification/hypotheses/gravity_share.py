"""Whether a part of gravity is left in a torque from which it was removed."""

from __future__ import annotations

from typing import Final

from identification.hypotheses.scores import Score, compare, score_of
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

# Of the weight: left, or removed in excess by a model that is too heavy.
_SHARES: Final = (0.1, -0.1)
_ERROR_RATIO: Final = 0.85  # that chance alone does not make
_SIGMAS: Final = 3.0


def has_part_of_gravity(model: RobotModel, samples: Samples, without: Score) -> bool:
    """Return whether a torque follows an arm with a tenth of its weight better than one without.

    Args:
        model: of the arm, with gravity.
        samples: of the recording.
        without: score of these without gravity.
    """
    for share in _SHARES:
        part = model.under_gravity(tuple((share * model.gravity).tolist()))
        found = compare(score_of(part, samples, without.columns), without, model)
        if found.ratio < _ERROR_RATIO and found.sigmas < -_SIGMAS:
            return True
    return False
