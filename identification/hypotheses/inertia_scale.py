r"""Whether inertia and weight in a torque have the ratio that the described arm has.

Recorded times that are k times too long make accelerations and squared speeds :math:`k^2` times too
small, and links that are s times as long have s times more inertia for their weight. Both are an
arm under gravity that is weaker by one factor, :math:`s = k^2`:

.. math:: \tau = s\,(M \ddot q + c(q, \dot q) + g(q) / s)

Gravity acts on first moments, and the coupling of the joints is that of first moments and lengths,
so that a torque whose masses are free says how long the links are, if the motion is fast enough.
The weight itself tells them apart: other times leave it as described, longer links do not.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from identification.estimators.prior import nominal_ratio
from identification.factor.factor import Factor
from identification.hypotheses.scores import (
    EXPLAINED_ERROR,
    SEPARATE_SIGMAS,
    SURE_SIGMAS,
    Comparison,
    Score,
    any_load,
    compare,
    fits_alike,
    score_of,
)
from identification.hypotheses.springs import may_have_springs, score_with_springs
from identification.model.nominal_masses import mass_fault
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_OTHER_TIMES: Final = (0.5, 2.0)  # recorded times over true ones
_TRIED: Final = (0.25, 0.5, 0.8, 1.25, 2.0, 4.0)
_FURTHER: Final = 2.0  # factor to the next, where the last is the best
_MOST: Final = 200.0  # times of a rate that is off by 14
_NARROWER: Final = 5  # steps of the golden section about the best
_GOLDEN: Final = 0.5 * (np.sqrt(5.0) - 1.0)
# Delay, low-pass and noise take torque from inertia, as if it were less.
_LESS: Final = 0.5  # error ratio that such a channel does not have
_TIME: Final = 0.7  # error ratio of times, of which few are off
# Factor of times below which links of 0.45 to 2.25 times the length explain it as well: another
# length need not have another weight.
_LEAST_TIME: Final = 1.5


class InertiaScale(NamedTuple):
    """By how much more inertia there is for the weight than described.

    Attributes:
        factor: of inertia over weight.
        error: of the torque with it, as a share.
        stated: without it.
        against: comparison of both.
        weight: ratio to the weight of the described masses; NaN where there are none.
    """

    factor: float
    error: float
    stated: float
    against: Comparison
    weight: float

    @property
    def time(self) -> float | None:
        """Recorded times over true ones, where these explain it; None where other lengths do.

        The weight is nearer to that described than to that of longer links of the same masses.
        """
        far = abs(np.log(self.factor))
        if not far > 2.0 * np.log(_LEAST_TIME) or not abs(np.log(self.weight)) < 0.5 * far:
            return None
        is_certain = self.against.ratio < _TIME and self.against.sigmas < -SURE_SIGMAS
        return float(np.sqrt(self.factor)) if is_certain else None


def find_inertia_scale(
    model: RobotModel, samples: Samples, score: Score, torque_scale: float = np.nan
) -> InertiaScale | None:
    """Return the factor that explains a torque much better; None if the described one does.

    None also where heavy rotors, a load or springs of the joints explain it as well.

    Args:
        model: of the arm.
        samples: of a recording, as read.
        score: of these.
        torque_scale: ratio of the torque to the described masses' torque; NaN if unknown.
            Longer links have more weight: that the torque is larger as well is evidence of them.
    """
    if not np.any(model.gravity):
        return None
    scores: dict[float, tuple[Score, Comparison]] = {1.0: (score, compare(score, score, model))}

    def ratio(factor: float) -> float:
        if factor not in scores:
            lighter = _lighter(model, factor)
            other = score_of(lighter, samples)
            scores[factor] = other, compare(other, score, lighter)
        return scores[factor][1].ratio

    best = min(_TRIED, key=ratio)
    if ratio(best) >= 1.0:
        return None
    best = _narrowed(ratio, best)
    scaled, against = scores[best]
    error = scaled.overall
    agrees = 1.0 < best < torque_scale
    least = 1.0 if best > 1.0 else _LESS
    if error > EXPLAINED_ERROR or against.sigmas > -(SEPARATE_SIGMAS if agrees else SURE_SIGMAS):
        return None
    if against.ratio > least:
        return None
    # Heavy rotors are inertia without weight as well, a load is weight far from most axes, and
    # springs carry weight.
    rivals = (
        score_of(model, samples, wide_rotors=True),
        score_of(model, samples, stated=any_load(model)),
        score_with_springs(model, samples, may_have_springs(model, samples)),
    )
    if any(rival is not None and fits_alike(rival, scaled, model) for rival in rivals):
        return None
    return InertiaScale(best, error, score.overall, against, _weight(model, samples, best))


def shows_times(model: RobotModel, samples: Samples, score: Score) -> bool:
    """Return whether a torque distinguishes times from times that are twice or half as long.

    It does not where friction hides the inertia, or the motion is slow. Without gravity nothing
    but the masses of the description does.

    Args:
        model: of the arm.
        samples: of a recording, as read.
        score: of these.
    """
    if not np.any(model.gravity):
        return False
    for time in _OTHER_TIMES:
        lighter = _lighter(model, time**2)
        if compare(score_of(lighter, samples), score, lighter).sigmas < SEPARATE_SIGMAS:
            return False
    return True


def retimed(model: RobotModel, samples: Samples, factor: float) -> Samples:
    """Return samples at their true times, if recorded times are too long by a factor."""
    motion = samples.motion
    start = motion.time[0]
    motion = replace(
        motion,
        time=start + (motion.time - start) / factor,
        velocity=motion.velocity * factor,
        acceleration=motion.acceleration * factor**2,
        direction=None,
    )
    return replace(samples, motion=motion).with_friction_direction(model)


def _narrowed(ratio: Callable[[float], float], best: float) -> float:
    """Return the factor of least error beyond or between the tried ones."""
    step = _FURTHER if best > 1.0 else 1.0 / _FURTHER
    while best in (_TRIED[0], _TRIED[-1]) or best not in _TRIED:
        if not 1.0 / _MOST < best * step < _MOST or ratio(best * step) >= ratio(best):
            break
        best *= step
    others = [1.0, *_TRIED, best / _FURTHER, best * _FURTHER]
    low = float(np.log(max(other for other in others if other < best)))
    high = float(np.log(min(other for other in others if other > best)))
    reached = [best]
    for _ in range(_NARROWER):
        inner = [high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)]
        first, second = (float(np.exp(each)) for each in inner)
        reached += [first, second]
        if ratio(first) < ratio(second):
            high = inner[1]
        else:
            low = inner[0]
    return min(reached, key=ratio)


def _lighter(model: RobotModel, factor: float) -> RobotModel:
    return model.under_gravity((model.gravity / factor).tolist())


def _weight(model: RobotModel, samples: Samples, factor: float) -> float:
    """Return the weight in a torque over the weight of the described masses."""
    if mass_fault(model) is not None:
        return float("nan")
    lighter = _lighter(model, factor)
    scale, _ = nominal_ratio(lighter, Factor.of(lighter, samples))
    return scale / factor if scale > 0.0 else float("nan")
