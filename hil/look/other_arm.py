"""Contradictions between a recording and its URDF: range, speed, size, lengths, torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from hil.base.arrays import Array
from hil.cell import Cell
from hil.importers.conclusions import Certainty
from hil.importers.plausibility import MAX_LIMIT_RATIO, limit_excess, whole_turns
from hil.look.physics import Size
from hil.look.readings import (
    BeyondEffort,
    BeyondMasses,
    BeyondRange,
    BeyondSpeed,
    Contradiction,
    Fact,
    NextStep,
    OtherAxes,
    OtherLengths,
    UnexplainedTorque,
)
from hil.look.result import Row
from identification.hypotheses.inertia_scale import find_inertia_scale
from identification.hypotheses.scores import Score
from identification.model.joint_ranges import urdf_limits
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_RANGE_QUANTILE: Final = 0.99  # quantile of the rows, so that single spikes are no evidence
_MAX_RANGE_EXCESS: Final = 0.17  # rad or m beyond a range; zeros of the same arm differ by less
_FAR_RANGE_EXCESS: Final = np.pi / 4.0  # the same, of one finding that is enough
_MAX_TURNS_OFF: Final = 3  # by which the count of an encoder may be off
# of the torque; right logs of short motions have up to 0.29 as well
_UNEXPLAINED_ERROR: Final = 0.15


@dataclass(frozen=True)
class Contradictions:
    """Contradictions to the arm, at most one of each kind, or None.

    The kinds are independent: another zero of a joint changes its motion alone, another unit of
    the torque the size alone. One cause of this sort does not explain two of them. A torque that
    is too small is no contradiction: it may be of the motor side, as the positions may.
    """

    motion: BeyondRange | BeyondSpeed | None = None
    size: BeyondEffort | BeyondMasses | None = None
    lengths: OtherLengths | None = None
    torque: UnexplainedTorque | None = None
    axes: OtherAxes | None = None
    #: whether a joint is farther beyond its range than zeros are off, or masses explain no torque
    #: of this size
    is_far: bool = False

    @classmethod
    def of(
        cls,
        cell: Cell,
        model: RobotModel,
        samples: Samples,
        score: Score,
        error: float,
        changed: Sequence[str] = (),
    ) -> Contradictions:
        """Compare samples of a recording, as read, with the URDF.

        Args:
            cell: of the arm.
            model: of it.
            samples: of the recording.
            score: of the samples.
            error: share of the torque that stays unexplained.
            changed: what of the axes (order, signs, zero) had to be changed for that.
        """
        limits = urdf_limits(cell.urdf, cell.joint_names)
        names = cell.joint_names
        position = samples.motion.position
        low, high = np.quantile(position, (1.0 - _RANGE_QUANTILE, _RANGE_QUANTILE), axis=0)
        turns = model.chain.revolute
        turns_aside = whole_turns(low, high, limits, turns, _MAX_TURNS_OFF)
        excess = limit_excess(low + turns_aside, high + turns_aside, limits)
        speed = _largest(samples.motion.velocity) / limits.velocity
        effort = _largest(samples.torque) / limits.effort
        motion: BeyondRange | BeyondSpeed | None = None
        size: BeyondEffort | BeyondMasses | None = None
        if excess.max() > _MAX_RANGE_EXCESS:
            joint = int(excess.argmax())
            motion = BeyondRange(names[joint], float(excess[joint]), turns=bool(turns[joint]))
        elif speed.max() > MAX_LIMIT_RATIO:
            joint = int(speed.argmax())
            motion = BeyondSpeed(names[joint], float(speed[joint]))
        expected = Size.of(cell, model, samples)
        factor = expected.factor or 1.0
        # A factor of 1000 is another unit, which a look names.
        if effort.max() > MAX_LIMIT_RATIO and not expected.is_thousand:
            joint = int(effort.argmax())
            size = BeyondEffort(names[joint], float(effort[joint]))
        elif expected.is_off and factor > 1.0 and not expected.is_thousand:
            size = BeyondMasses(factor, expected.by_masses)
        by_masses = factor if expected.by_masses else np.nan
        inertia = find_inertia_scale(model, samples, score, by_masses)
        lengths = None
        if inertia is not None and inertia.time is None:
            lengths = OtherLengths(inertia.factor, inertia.error, inertia.stated)
        is_open = error > _UNEXPLAINED_ERROR and inertia is None
        torque = UnexplainedTorque(error) if is_open else None
        axes = OtherAxes(tuple(changed)) if len(changed) > 1 else None
        is_larger = isinstance(size, BeyondMasses) and size.by_masses
        is_far = is_larger or bool(np.any(excess > np.where(turns, _FAR_RANGE_EXCESS, np.inf)))
        return cls(motion, size, lengths, torque, axes, is_far=is_far)

    @property
    def found(self) -> tuple[Contradiction, ...]:
        """The contradictions there are."""
        kinds = (self.motion, self.size, self.lengths, self.torque, self.axes)
        return tuple(each for each in kinds if each is not None)

    @property
    def row(self) -> Row:
        """The row of a look about a doubtful arm."""
        step = NextStep.GIVE_URDF_OF_THIS_ARM
        return Row("arm", Fact.OTHER_ARM, Certainty.UNDETERMINED, self.found, step)

    @property
    def is_doubtful(self) -> bool:
        """Whether it may be another arm, by one sufficient finding or by two."""
        return self.is_far or self.lengths is not None or len(self.found) > 1


def _largest(values: Array) -> Array:
    return np.asarray(np.quantile(np.abs(values), _RANGE_QUANTILE, axis=0))
