"""One check of a verdict and what came out; the limits that a good result keeps to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

Level = Literal["good", "information", "doubtful", "wrong"]
Role = Literal["condition", "cause", "symptom"]


@dataclass(frozen=True)
class Finding:
    """Outcome of one check."""

    check: str  # what was looked at, in two or three words
    # "wrong" is a reason not to use the model, "doubtful" is worth a word, "information" is
    # neither good nor bad
    level: Level
    words: str  # what was found, in a sentence without its full stop
    next_step: str = ""  # what to do about it; empty where nothing needs doing
    # a cause explains errors, and its step is always given; a symptom is an error, and its step
    # is a guess that is given only where no cause was found
    role: Role = "condition"


def joined(names: Sequence[str], most: int = 6) -> str:
    """Names in a row, the first few of many."""
    rest = len(names) - most
    return ", ".join(names[:most]) + (f" and {rest} more" if rest > 0 else "")


@dataclass(frozen=True)
class Thresholds:
    """What a good result keeps to. Shares are of the axis's measured torque, both as RMS.

    The figures come from simulated NS 16 campaigns in which one sign was turned (each gear
    ratio, each wrist coupling, each torque constant, each Coulomb and viscous friction) against
    campaigns without a fault, unmodelled effects off and on.
    """

    #: relative torque error over all axes. Published fits of real arms: 4 to 9 %
    overall: float = 0.12
    #: relative torque error of one axis, noise included. Wrist axes of real arms, whose torque is
    #: mostly friction, reach 20 %
    axis: float = 0.35
    #: share of an axis's torque variance (R²) that must be explained: a model that does not beat
    #: the mean torque has learned nothing about the axis
    explained: float = 0.0
    little_explained: float = 0.5  #: share below which an axis is doubtful
    #: slow error of one axis that neither noise nor a change of friction explains. Right models:
    #: below 0.1 % without, 1.9 % with ripple, drifting friction, elasticity and delay. One turned
    #: sign: 4.2 % and more on some axis
    systematic: float = 0.03
    #: the same, worth a word. Torque constants of wrist axes that are wrong by 30 % show as 1 to
    #: 3 %
    noticeable: float = 0.02
    #: error of predicted blocks of the fit with a fault mended, over that as it is, below which
    #: the fault is a reason to say no; signs and orders always are
    cause: float = 0.7
    #: error over all axes that may stay without a cause however small the noise is
    unexplained: float = 0.06
    multiple: float = 5.0  #: of the noise floor up to which an error may be larger than that
    #: difference of torque between one repetition's own estimate and the pooled one. Noise of the
    #: size that `axis` allows makes 2 %
    inconsistency: float = 0.10
    #: change of friction between training and unseen motion that is worth a word. Up to 10 % are
    #: forgiven before `systematic` is looked at; a larger change is a reason to say no where it
    #: alone takes an axis beyond `systematic`
    friction: float = 0.03
    #: change of an axis's friction in the course of the recordings, as a share of its torque,
    #: that is more than information
    drift: float = 0.03
    #: error on unseen motion over that on the training motion, per axis: above, it is doubtful,
    #: and wrong where the axis also misses by more than half of `axis`
    generalisation: float = 2.5
    #: by how much the overall error may exceed that of the nominal model, or of the controller's
    #: own
    nominal: float = 0.005
    rows: int = 100  #: samples of unseen motion that an axis must have moved for
    #: squared error on unseen motion with gravity pulling the way that fits best, over that as
    #: declared, to call gravity wrong
    gravity: float = 0.5
    #: degrees between the two. NS 16: 0.06 at most with gravity 10° off,
    #: 1.0 and more with any other fault
    gravity_angle: float = 1.0
    #: share of what the error on unseen motion exceeds that of the fit by that a body on the last
    #: link must explain. A body that was there: 0.99 and more. Friction, turned axes, wrong
    #: constants: 0.7 at most
    load: float = 0.8
    #: share of an axis's samples up to which those far outside are single ones
    outliers: float = 0.05
    #: share of the squared residual they must make. Planted spikes: more than 0.9. The heavy
    #: tails of a sound recording (UR10, its last wrist axis): 0.5
    outlying_power: float = 0.8
    #: share of the torque that a pattern of the residual (over speed, position or motor angle)
    #: must make, besides exceeding the noise, to be worth a word
    pattern: float = 0.005
    #: share of the residual: a tenth of its power is not what to mend first
    pattern_of_residual: float = 0.3
    #: torque ripple that is more than information. Healthy drives have 1 to 2 %
    ripple: float = 0.03
    #: independent samples per parameter below which a record is short, the usual rule of thumb of
    #: regression
    rows_per_parameter: float = 10.0
    saturated: float = 0.001  #: share of an axis's samples at the limit that is worth a word
    #: difference between the delay found and the one assumed [cycles of the clock] that is worth
    #: a word, if three standard errors leave it as well. The estimate is good to 0.2 cycles in
    #: closed loop; half a cycle changes the torque by less than 0.3 %
    delay: float = 0.6
    #: condition number of the weighted regressor with columns of unit length, above which
    #: parameters are known only in combination. Designed motions of the NS 16: 30
    condition: float = 100.0
