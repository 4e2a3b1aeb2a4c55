"""What is left over, looked at from all sides: is it noise, and if not, what does it follow?

The samples are read once more, one recording at a time; of each only sums are kept. A check
gives its size as a share of the torque and whether it stands out of noise. Both matter: of a
long recording the smallest error is significant, and of a short one a large one may be chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from numpy.typing import NDArray

from identification.autocorrelation import Autocorrelation, autocorrelation, steps_of
from identification.errors import IdentificationError
from identification.friction_drift import (
    FrictionDrift,
    drift_sums,
    friction_drift,
    pieces_per_recording,
)
from identification.model import RobotModel
from identification.outliers import Outliers, find_outliers
from identification.preprocessing import Samples
from identification.residual_blocks import BlockSums
from identification.residual_profile import Profile, equal_edges, profile_sums
from identification.ripple import Ripple, ripple_sums

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ResidualChecks:
    """What the torque residual of all recordings follows.

    Attributes:
        torque_rms: measured torque of the rows that count (n,) [N·m or N].
        rms: residual of those rows (n,) [N·m or N].
        colour: correlation in time, of what was fitted.
        speed: mean residual against the joint's own speed.
        position: against the joint's own position.
        ripple: against the angle of the joint's motor; None where no gear ratio is known.
        drift: change of friction over the fitted recordings; None where they are too few.
        friction_share: friction torque of the fitted recordings over the measured one (n,).
        outliers: of the unseen motion, or of the fitted one where there is no other.
    """

    torque_rms: Array
    rms: Array
    colour: Autocorrelation
    speed: Profile
    position: Profile
    ripple: Ripple | None
    drift: FrictionDrift | None
    friction_share: Array | None = None
    outliers: Outliers | None = None

    def share(self, size: Array) -> Array:
        """A residual (n,) as a share of the joint's torque; zero for a joint without rows."""
        torque = self.torque_rms
        return np.where(torque > 0.0, size / np.where(torque > 0.0, torque, 1.0), 0.0)


def check_residuals(
    model: RobotModel,
    values: Array,
    training: Sequence[Samples],
    held_out: Sequence[Samples] = (),
    *,
    same_motion: bool = False,
    motor_from_joint: Array | None = None,
) -> ResidualChecks:
    """Look at the residuals of parameters (p,) on all recordings.

    Args:
        model: the robot.
        values: parameters (p,).
        training: recordings in the order in which they were made; drift is looked for in these.
        held_out: recordings of other motions.
        same_motion: whether the training recordings repeat one motion.
        motor_from_joint: motor angle per joint angle (n, n); None where unknown.

    Raises:
        IdentificationError: no recording.
    """
    runs = [*training, *held_out]
    if not runs:
        raise IdentificationError("there is no residual to check: no recording is given")
    usable = [run.usable for run in runs]
    speeds = equal_edges([run.motion.velocity for run in runs], usable)
    positions = equal_edges([run.motion.position for run in runs], usable)
    pieces = pieces_per_recording(len(training))
    heat = np.where(model.friction_columns, values, 0.0)
    squares, fitted_torque = np.zeros((3, model.n_joints)), np.zeros(model.n_joints)
    speed, position, ripple, drift, left = [], [], [], [], []
    for index, run in enumerate(runs):
        residual = run.torque - run.predicted_torque(model, values)
        residual = np.where(run.usable, residual, 0.0)
        left.append((residual, run.usable))
        squares += [
            (np.where(run.usable, run.torque, 0.0) ** 2).sum(axis=0),
            (residual**2).sum(axis=0),
            np.count_nonzero(run.usable, axis=0),
        ]
        speed.append(profile_sums(run, residual, run.motion.velocity, speeds))
        position.append(profile_sums(run, residual, run.motion.position, positions))
        if motor_from_joint is not None:
            ripple.append(ripple_sums(run, residual, motor_from_joint))
        if index < len(training):
            drift.append(drift_sums(run, residual, run.predicted_torque(model, heat), pieces))
            fitted_torque += (np.where(run.usable, run.torque, 0.0) ** 2).sum(axis=0)
    repeated = len(training) if same_motion else 1
    rows = np.maximum(squares[2], 1.0)
    judged = runs[len(training) :] or runs
    friction = sum((one.power.sum(axis=0) for one in drift), np.zeros(model.n_joints))
    return ResidualChecks(
        torque_rms=np.sqrt(squares[0] / rows),
        rms=np.sqrt(squares[1] / rows),
        colour=autocorrelation(
            left[: len(training)] or left,
            steps_of([run.motion.time for run in training or runs]),
        ),
        speed=Profile(speeds, _joined(speed, repeated).mean()),
        position=Profile(positions, _joined(position, repeated).mean()),
        ripple=Ripple(_joined(ripple, repeated).mean()) if ripple else None,
        drift=friction_drift(drift),
        friction_share=np.sqrt(friction / np.where(fitted_torque > 0.0, fitted_torque, 1.0)),
        outliers=find_outliers(
            [(run.torque, *of) for run, of in zip(judged, left[-len(judged) :], strict=True)]
        ),
    )


def _joined(parts: Sequence[BlockSums], repeated: int) -> BlockSums:
    """All blocks; the first `repeated` recordings are of one motion and share theirs."""
    first = reduce(lambda a, b: a.plus(b, same_motion=True), parts[:repeated])
    return reduce(lambda a, b: a.plus(b, same_motion=False), parts[repeated:], first)
