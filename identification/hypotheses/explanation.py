"""What explains the errors of a fit, as a value: a change with its size and its rivals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from identification.arrays import Array
from identification.distributions import SIGNIFICANT_SIGMAS
from identification.hypotheses.column_scores import SEPARATE_ERROR_RATIO
from identification.hypotheses.joint_changes import Change
from identification.hypotheses.sizes import ScorePrior


class Explanation(NamedTuple):
    """A change that explains errors.

    Attributes:
        change: of the recordings, with its joints and part.
        ratio: error of predicted blocks with it over that without, geometric mean over the joints.
        size: delay [s], drift [rad], factor less one, mass [kg] or share of the load; None without
            a size.
        std: standard deviation of it over the blocks.
        interval_factor: standard deviations in half a 95 % interval.
        rivals: other changes that explain its part as well, or several at once that explain more,
            the best first.
        excess: ratio of the error of its part, with it, to the error of the other blocks; 1.0 if
            not significantly higher.
        others: further changes of its part, where they are not certain.
    """

    change: Change
    ratio: float
    size: float | None = None
    std: float = 0.0
    interval_factor: float = 2.0
    rivals: tuple[tuple[Change, ...], ...] = ()
    excess: float = 1.0
    others: tuple[Change, ...] = ()

    @property
    def is_certain(self) -> bool:
        """Whether it is clearly not zero, nothing else explains as much, and nothing is left."""
        if self.size is None:
            is_something = self.change.meaning != "payload"  # a load has a mass
        else:
            is_something = abs(self.size) > self.half_interval
        return is_something and not self.rivals and self.excess <= SEPARATE_ERROR_RATIO

    def is_assumed(self, scale_std: Array) -> bool:
        """Return whether it is a torque constant within what is assumed of the torques' scales.

        Args:
            scale_std: relative standard deviation of each joint's torque scale (n,).
        """
        if not self.change.is_constant or self.size is None:
            return False
        return abs(self.size) <= SIGNIFICANT_SIGMAS * self.relative_std(scale_std)

    def relative_std(self, scale_std: Array) -> float:
        """Return the deviation of a torque constant relative to the others, of these deviations."""
        return math.hypot(scale_std[[*self.change.joints]].max(), self.std)

    @property
    def half_interval(self) -> float:
        """Half a 95 % interval of the size."""
        return self.interval_factor * self.std


@dataclass(frozen=True, eq=False)
class ExplainedFit:
    """A fit of recordings whose errors are to be explained.

    Attributes:
        values: its parameters (p,).
        noise: standard deviation of each joint's torque noise (n,) [N·m or N], NaN where unknown;
            None if it has none.
        names: of the recordings, by default numbers.
        prior: what is believed of the arm.
        scale_std: relative standard deviations (n,) of the torques' scales, which the intervals of
            sizes include; None: exact.
    """

    values: Array
    noise: Array | None = None
    names: Sequence[str] = ()
    prior: ScorePrior | None = None
    scale_std: Array | None = None

    def name_of(self, recording: int) -> str:
        """Return the name of a recording."""
        named = recording < len(self.names)
        return self.names[recording] if named else f"recording {recording + 1}"
