"""How a recording is to be read: the adopted changes, and what else fits the rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

from identification.hypotheses.joint_changes import DEGREE, SIGNS, SIZED, Axes, Change, Meaning
from identification.hypotheses.joint_fit import PositionScales
from identification.hypotheses.mirror_images import SignRival, Signs
from identification.hypotheses.scores import (
    ALIKE_REDUCTION,
    EXPLAINED_ERROR,
    LARGE_REDUCTION,
    SEPARATE_SIGMAS,
    SURE_SIGMAS,
    Comparison,
    Score,
)
from identification.model.robot import RobotModel
from identification.signals.samples import Samples

_ADEQUATE_ERROR_RATIO: Final = 1.2  # error ratio to a free fit, of a reading that explains the rows
# The same of each joint, as a mean hides one that is not explained: of four joints that share one
# error the mean reaches 1.2 where that of one alone is 2.
_ADEQUATE_JOINT_ERROR_RATIO: Final = 2.0
# A joint turned by more than a right angle is nearer to its reverse, so that its sign and a nearer
# zero may look alike.
_FAR_ZERO: Final = 90.0 * DEGREE


@dataclass(frozen=True, eq=False)
class Step:
    """An adopted change, and the changes that fit equally well.

    `error` and `before` are errors over all joints with and without it; `alike` are other changes
    with their errors, of which only knowledge of the arm can choose. `springs` are springs of
    joints that explain the rows as well in place of it, with the error then: they are of the arm,
    and no other way to read the recording.
    """

    change: Change
    error: float
    before: float
    ratio: float
    sigmas: float
    alike: tuple[tuple[Change, float], ...] = ()
    is_adequate: bool = True  # whether no free fit explains the rows much better
    springs: tuple[tuple[Change, float], ...] = ()

    @property
    def is_clear(self) -> bool:
        """Whether the arm explains the torque with it, and certainly worse without."""
        is_certain = not self.by_friction and not self.springs and self.sigmas < -SURE_SIGMAS
        return self.error < EXPLAINED_ERROR and is_certain

    @property
    def is_explained(self) -> bool:
        """Whether that is so, and no free fit explains the torque much better."""
        return self.is_clear and self.is_adequate

    @property
    def is_far(self) -> bool:
        """Whether it is a zero that no assembly has."""
        return self.change.meaning == "zero" and abs(self.change.size) > _FAR_ZERO

    @property
    def by_friction(self) -> bool:
        """Whether friction supports it, and the error little or not at all."""
        return self.ratio > 1.0 - ALIKE_REDUCTION

    @property
    def sure(self) -> bool:
        """Whether nothing else fits alike, and the arm explains the torque as a free fit does.

        Friction, or a slightly smaller error, says it of a whole arm; of one joint a lag of the
        torque looks the same.
        """
        slight = self.ratio > 1.0 - LARGE_REDUCTION and len(self.change.joints) == 1
        if self.change.meaning in SIZED:
            slight = self.sigmas > -SEPARATE_SIGMAS
        is_alone = not self.alike and not self.springs
        return is_alone and self.error < EXPLAINED_ERROR and not slight and self.is_adequate


@dataclass(frozen=True)
class Adequacy:
    """How a reading compares with a free fit of the same rows.

    The free fit has any zero and scale of each joint, and hardly believes the masses of the URDF.

    Attributes:
        ratio: error with the reading over that of the free fit, mean over the joints.
        largest: of the joints.
        agrees: whether the free fit has the same zeros and scales.
    """

    ratio: float
    largest: float
    agrees: bool

    @property
    def is_enough(self) -> bool:
        """Whether the reading explains the rows about as well."""
        return (
            self.agrees
            and self.ratio < _ADEQUATE_ERROR_RATIO
            and self.largest < _ADEQUATE_JOINT_ERROR_RATIO
        )


@dataclass(frozen=True, eq=False)
class Readings:
    """How a recording is to be read.

    Attributes:
        steps: changes of what was recorded, in order.
        model: with the gravity that was found.
        samples: few rows, as read.
        score: of these.
        nearest: by meaning, the change that comes nearest to the reading found, compared with it.
        unseen_zeros: joints of which the torque shows no zero: others fit alike.
        adequacy: whether nothing else explains the rows much better.
        rivals: signs of the joints that explain the rows alike, fewest changes first.
        no_better: changes that fit best, by no more than chance: the recording is read without.
        scales: of the positions, where the numbers alone say their unit.
    """

    steps: tuple[Step, ...]
    model: RobotModel
    samples: Samples
    score: Score
    nearest: Mapping[Meaning, tuple[Change, Comparison]]
    unseen_zeros: tuple[int, ...] = ()
    adequacy: Adequacy = Adequacy(1.0, 1.0, agrees=True)
    rivals: tuple[SignRival, ...] = ()
    no_better: tuple[Change, ...] = ()
    scales: PositionScales | None = None

    @property
    def disputed_signs(self) -> tuple[Step, ...]:
        """The signs that were found, and are others where the rows are explained alike."""
        axes = Axes.of((step.change for step in self.steps), self.model.n_joints)
        signs = Signs.of(axes)
        return tuple(step for step in self.steps if is_disputed(step, signs, self.rivals))


def is_disputed(step: Step, signs: Signs, rivals: Sequence[SignRival]) -> bool:
    """Return whether a step is of signs that are others where the rows are explained alike.

    So is the zero of a position that was negated, as its direction is.
    """
    joints = list(step.change.joints)
    is_of_negated = step.change.meaning == "zero" and bool((signs.position[joints] < 0.0).any())
    return (step.change.meaning in SIGNS or is_of_negated) and not all(
        signs.agrees(rival.signs, joints) for rival in rivals
    )
