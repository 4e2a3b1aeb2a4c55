"""Findings of a verdict, how they name joints and motion, and the thresholds of its checks."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from identification.hypotheses.carried_load import LOAD
from identification.hypotheses.little_torque import MINOR

Mask = NDArray[np.bool_]
Level = Literal["good", "information", "doubtful", "wrong"]
Role = Literal["condition", "cause", "symptom"]


@dataclass(frozen=True)
class Finding:
    """Outcome of one check."""

    check: str  # name of the check
    # "wrong": the model must not be used; "doubtful": a warning; "information": neutral
    level: Level
    words: str  # message without full stop
    next_step: str = ""  # remedy; empty if none is needed
    # a "cause" explains errors; the step of a "symptom" is given only if no cause was found
    role: Role = "condition"
    # what a model that predicts well must not be used for without care, for the verdict's sentence
    reservation: str = ""
    # share of the squared error that is gone with this corrected, 0 to 1; None: not measured
    explains: float | None = None
    # indices of the joints that it names; empty if it names none
    joints: tuple[int, ...] = ()


def indices(mask: Mask) -> tuple[int, ...]:
    """Return the joints of a mask (n,), from 0."""
    return tuple(np.flatnonzero(mask).tolist())


def joined(names: Sequence[str], most: int = 6) -> str:
    """Return names separated by commas, the first few of many."""
    omitted = len(names) - most
    return ", ".join(names[:most]) + (f" and {omitted} more" if omitted > 0 else "")


@dataclass(frozen=True)
class Naming:
    """Names in messages: those of the joints, and of the motion that was predicted."""

    joints: tuple[str, ...]
    motion: str  # such as "unseen motion"

    def of(self, mask: Mask) -> str:
        """Return the joints of a mask (n,)."""
        return joined([self.joints[joint] for joint in np.flatnonzero(mask)])

    def all_of(self, joints: Sequence[int]) -> str:
        """Return joints by their indices."""
        return joined([self.joints[joint] for joint in joints])

    def each(self, mask: Mask, entry: Callable[[int], str]) -> str:
        """Return the joints of a mask (n,), each with its entry: ``joint_1 3 %, joint_2 5 %``."""
        return joined([f"{self.joints[j]} {entry(j)}" for j in np.flatnonzero(mask).tolist()])


class Facts(Protocol):
    """What evidence says about one subject, with the findings that follow from it."""

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the findings in the order of the verdict's reasons."""


@dataclass(frozen=True)
class Thresholds:
    """Limits of a good result; shares are RMS values over the RMS measured torque of the axis.

    Derived from simulated NS 16 campaigns without a fault and with one wrong sign of the drive
    train.
    """

    #: relative torque error over all axes that no noise excuses; published fits: 4 to 9 %
    overall: float = 0.1
    noise: float = 2.0  #: noise floors up to which an error is that of the recording
    axis: float = 0.35  #: relative torque error of one axis; wrists of real arms reach 20 %
    explained: float = 0.0  #: R² of an axis up to which the model is wrong
    little_explained: float = 0.5  #: R² below which an axis is doubtful
    #: slow error of one axis beyond noise and change of friction. Right models: at most 1.9 % (with
    #: ripple, friction drift, elasticity, delay); one wrong sign: 4.2 % and more on some axis
    systematic: float = 0.03
    #: the same, doubtful; a wrist torque constant wrong by 30 % causes 1 to 3 %
    noticeable: float = 0.02
    #: error ratio with a fault corrected below which it is wrong, on its joints; signs and orders
    #: always are
    cause: float = 0.7
    unexplained: float = 0.06  #: error over all axes accepted without a cause, whatever the noise
    multiple: float = 5.0  #: the same, in noise floors
    inconsistency: float = 0.10  #: torque difference of one repetition's estimate to the pooled one
    friction: float = 0.03  #: change of friction to unseen motion that is doubtful
    drift: float = 0.03  #: change of friction during the recordings, as a share of the torque
    #: error on unseen over error on fitted motion, as shares of the torque; wrong if also above
    #: half of `axis`, above `unexplained` if the torque error itself has grown by a half
    generalisation: float = 2.5
    #: torque of an axis as a share of that of all axes below which it alone does not decide
    minor: float = MINOR
    #: the same as a share of its own limit; sensors resolve some thousandths of their range
    minor_of_limit: float = 0.005
    nominal: float = 0.005  #: overall error above that of the nominal or controller's model
    #: seconds of unseen motion in which an axis must have moved: four blocks of the covariance, of
    #: which an error has a standard deviation of a third of it
    moved: float = 0.5
    gravity: float = 0.5  #: squared error on unseen motion with the best gravity over declared
    gravity_angle: float = 1.0  #: degrees between the two. Other faults on the NS 16: up to 0.06
    load: float = LOAD  #: share of the additional error that a body on the last link explains
    outliers: float = 0.05  #: largest share of samples that counts as outliers
    #: their share of the squared residual. Injected spikes: above 0.9; heavy tails (UR10): 0.5
    outlying_power: float = 0.8
    pattern: float = 0.005  #: torque share of a residual pattern (speed, position, motor angle)
    pattern_of_residual: float = 0.3  #: its share of the residual
    ripple: float = 0.03  #: torque ripple; normal drives: 1 to 2 %
    rows_per_parameter: float = 10.0  #: independent samples per parameter
    saturated: float = 0.001  #: share of samples at the limit
    #: delay minus assumed delay in clock cycles, besides three standard errors; the estimate is
    #: accurate to 0.2 cycles
    delay: float = 0.6
    condition: float = 100.0  #: condition number with unit columns; designed NS 16 motions: 30
