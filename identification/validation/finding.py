"""Findings of a verdict, as values, and the thresholds of its checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from identification.hypotheses import gravity_direction
from identification.hypotheses.carried_load import MIN_LOAD_EXPLAINED
from identification.hypotheses.joint_changes import Change, Coupled, Order, Sign
from identification.hypotheses.little_torque import LITTLE_TORQUE_SHARE
from identification.model.friction import FrictionLaw
from identification.signals.position_steps import PositionJump
from identification.signals.row_faults import RowFaults
from identification.signals.sample_times import SampleTimes
from identification.validation.consistency import ConsistencyCheck
from identification.validation.physical_signs import SignKind

Mask = NDArray[np.bool_]


class TestedOn(StrEnum):
    """Kind of the predicted motion; persons and programs read the value."""

    __test__ = False  # no test, whatever its name

    UNSEEN = "unseen motion"
    REST = "the rest of the same motion"
    REPETITION = "a repetition of the fitted motion"
    ANOTHER_RECORDING = "another recording"
    FITTED = "the motion that was fitted"
    RECORDINGS = "the recordings"  #: of commands that predict none


Level = Literal["good", "information", "doubtful", "wrong"]
Role = Literal["condition", "cause", "symptom"]


FindingKey = Literal[
    # the recordings
    "nothing held out",
    "joints not fitted",
    "joints at rest",
    "no torque",
    "position jumps",
    "play",
    "faulty rows",
    "spikes",
    "commanded positions",
    "counted rows",
    "retimed",
    "repeated samples",
    "unwrapped angles",
    "coarse positions",
    "coarse positions at rest",
    "folded noise",
    "saturation",
    "no saturation",
    # excitation
    "undetermined",
    "undetermined in one direction",
    "poor excitation",
    "one direction",
    "good excitation",
    # what the recordings are
    "no bodies",
    "no gravity",
    "part of gravity",
    "rate of a torque",
    "other times",
    "torque of another run",
    "rows backwards",
    "zeros",
    "zeros, not all certain",
    "zeros, nearest",
    "alike",
    "nearest",
    "another arm",
    "gravity",
    "scale of the torque",
    "all torques opposite",
    "all axes driven by friction",
    "torque opposite",
    "outliers",
    # what explains the error
    "delay of the torque",
    "drift of a joint",
    "torque constant",
    "torque constant or spring",
    "spring",
    "torque constant, as assumed",
    "load friction",
    Sign,
    Order,
    Coupled,
    "payload of a part",
    "torque of a part",
    "friction of a part",
    "arm of a part",
    "undetermined change of a part",
    "unexplained part",
    # what differs on unseen motion
    "load",
    "changed torque",
    "changed friction",
    "slightly changed friction",
    # bodies and friction
    SignKind,
    "no consistent parameters",
    "friction law lacks a term",
    "complete friction law",
    "chosen friction law",
    "chosen friction law in place of the stated",
    # errors
    "overall error",
    "axis error",
    "axis error of little torque",
    "axis error on unseen motion alone",
    "unexplained error",
    "undetermined by the motion",
    "nothing explained",
    "little explained",
    "explained",
    "generalisation",
    "no repetitions",
    "systematic error",
    "different repetitions",
    # other models
    "nominal model better",
    "nominal model worse",
    "controller's model better",
    "controller's model worse",
    "controller's inertia differs",
    "controller's inertia agrees",
    # delay and filter
    "compensated delay",
    "delay chosen by prediction",
    "suspected delay",
    "other delay",
    "assumed delay",
    "filtered torque",
    "filtered or computed torque",
    # the residual
    "short recordings",
    "correlated residual",
    "residual over speed",
    "no residual over speed",
    "residual over position",
    "no residual over position",
    "large ripple",
    "usual ripple",
    "no ripple",
    "ripple over the angle",
    "large friction drift",
    "small friction drift",
    "no friction drift",
]
"""What a finding is; `identification.validation.finding_messages` has the sentence of each."""

RemedyKey = Literal[
    "hold out a motion",
    "move the joints",
    "resolve the torque",
    "check the encoder",
    "check the encoder of a joint",
    "describe the spring",
    "find why the logger stopped",
    "check what wrote rows twice",
    "check what displaced rows",
    "separate the motions",
    "check for damaged packets",
    "record the positions",
    "state the sampling rate",
    "log the time",
    "log each sample once",
    "record more digits",
    "record more digits, or leave slow rows out",
    "log at a higher rate",
    "slow the motion down",
    "design a motion",
    "move in both directions",
    "record all torque",
    "state that gravity was removed",
    "record the torque itself",
    "record both in one run",
    "reverse the rows",
    "correct the zeros",
    "correct the zeros if so",
    "compare a posture",
    "jog and compare",
    "compare with the map",
    "check masses and units",
    "state the mounting",
    "check the scale",
    "negate all torques",
    "check the sign of the torque",
    "check the torque for spikes",
    "check the positions for steps",
    "record torque with gravity",
    "use the delay found",
    "check the constant",
    "fit load friction",
    "check the sign in the map",
    "check the sign of the position",
    "jog the axes",
    "check the order",
    "state the coupled angle",
    "state the coupled difference",
    "state the coupled drive",
    "state the opposite coupled drive",
    "separate the payloads",
    "check what changed in between",
    "find what changed in between",
    "separate the arms",
    "record with one payload",
    "check what changed",
    "warm the arm up",
    "warm the arm up, and check what else changed",
    "check all signs",
    "describe a balancer",
    "use the consistent estimate",
    "compare with basic friction",
    "describe the friction",
    "keep the stated friction",
    "describe elements, or check the drives",
    "cover the motion",
    "cover the motion in both directions",
    "cover the motion, or check what changed",
    "check the drives",
    "check the drives and the unit",
    "move faster",
    "check for missing effects",
    "repeat the motion",
    "check the coupling",
    "check the constant with a payload",
    "compare the repetitions",
    "use the nominal model",
    "fit more before replacing the controller's",
    "check the constant and the payload",
    "state the delay",
    "state the delay, or correct the program",
    "compare with the delay found",
    "compare with the delay found, or correct the cell",
    "record the torque unfiltered",
    "record a longer motion",
    "try friction terms",
    "check the geometry",
    "average the ripple",
    "measure the play",
]
"""What to do about a finding, in the same form."""

Figure = float | str


@dataclass(frozen=True)
class RepeatedSamples:
    """Samples of a joint that a log repeats, delays or lacks."""

    joint: str
    count: int
    recording: str


Value = (
    Figure
    | Change
    | PositionJump
    | RowFaults
    | SampleTimes
    | ConsistencyCheck
    | FrictionLaw
    | tuple[str, ...]
    | tuple[int, ...]
    | tuple[float, ...]
    | tuple[Change, ...]
    | tuple[tuple[Change, ...], ...]
    | tuple[PositionJump, ...]
    | tuple[RepeatedSamples, ...]
)


@dataclass(frozen=True)
class Finding:
    """Outcome of one check, as values; `finding_messages` makes the sentences."""

    key: FindingKey
    # "wrong": the model must not be used; "doubtful": a warning; "information": neutral
    level: Level
    remedy: RemedyKey | None = None
    # a "cause" explains errors; the step of a "symptom" is given only if no cause was found
    role: Role = "condition"
    values: Mapping[str, Value] = field(default_factory=dict)
    # share of the squared error that is gone with this corrected, 0 to 1; None: not measured
    explains: float | None = None
    # indices of the joints that it names; empty if it names none
    joints: tuple[int, ...] = ()
    each: Mapping[str, tuple[Figure, ...]] = field(default_factory=dict)  # of each of these

    def about(self, joints: Mask, **each: NDArray[Any] | Sequence[Figure]) -> Finding:
        """Return the finding about the joints of a mask (n,), with figures of all joints (n,)."""
        indices = np.flatnonzero(joints)
        figures = {name: tuple(np.asarray(all_)[indices].tolist()) for name, all_ in each.items()}
        return replace(self, joints=tuple(indices.tolist()), each=figures)


@dataclass(frozen=True)
class Thresholds:
    """Limits of a good result; shares are RMS values over the RMS measured torque of the axis.

    Derived from simulated NS 16 campaigns without a fault and with one wrong sign of the drive
    train.
    """

    #: relative torque error over all axes that no noise excuses; published fits: 4 to 9 %
    overall: float = 0.1
    noise: float = 2.0  #: noise floors up to which an error is the recording's own
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
    #: share of an axis in the torque of all axes below which it alone does not decide
    minor: float = LITTLE_TORQUE_SHARE
    #: the same as a share of its own limit; sensors resolve some thousandths of their range
    minor_of_limit: float = 0.005
    nominal: float = 0.005  #: overall error above the nominal or controller model's
    #: seconds of unseen motion in which an axis must have moved: four blocks of the covariance, of
    #: which an error has a standard deviation of a third of it
    moved: float = 0.5
    #: squared error on unseen motion with the best gravity over declared
    gravity: float = gravity_direction.MAX_ERROR_RATIO
    gravity_angle: float = gravity_direction.MIN_ANGLE  #: degrees between the two
    load: float = (
        MIN_LOAD_EXPLAINED  #: share of the additional error that a body on the last link explains
    )
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
