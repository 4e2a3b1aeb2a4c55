"""What contradicts the arm of a URDF in a recording: its range and speed, its size, its torque."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.cell import Cell
from hil.cell.text import urdf_limits
from hil.importers.findings import in_turns
from hil.look.physics import Size
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.text import percentage

Array = NDArray[np.float64]

_MOST: Final = 0.99  # quantile of the rows, so that single spikes are no evidence
_BEYOND: Final = 0.17  # rad or m beyond a range; zeros of the same arm differ by less
_OVER: Final = 3.0  # of a speed or torque; right logs of real arms reach 1.7 of a stated torque
_UNEXPLAINED: Final = 0.15  # of the torque; right logs of short motions have up to 0.29 as well


@dataclass(frozen=True)
class Contradictions:
    """What contradicts the arm, one sentence of each kind; "" for none.

    The kinds are independent: another zero of a joint changes its motion alone, another unit of
    the torque the size alone. One cause of this sort does not explain two of them. A torque that
    is too small is no contradiction: it may be of the motor side, as the positions may.
    """

    motion: str
    size: str
    torque: str
    axes: str

    @classmethod
    def of(
        cls,
        cell: Cell,
        model: RobotModel,
        samples: Samples,
        error: float,
        changed: Sequence[str] = (),
    ) -> Contradictions:
        """Compare samples of a recording, as read, with the URDF.

        `error` is the share of the torque that stays unexplained, `changed` names what of the axes
        (order, signs, zero) had to be changed for that.
        """
        limits = urdf_limits(cell.urdf, cell.joint_names)
        names = cell.joint_names
        turning = np.array(model.chain.revolute)
        position = in_turns(samples.motion.position, limits, turning)
        low, high = np.quantile(position, (1.0 - _MOST, _MOST), axis=0)
        beyond = np.maximum(limits.lower - low, high - limits.upper)
        speed = _largest(samples.motion.velocity) / limits.velocity
        effort = _largest(samples.torque) / limits.effort
        motion = size = torque = ""
        if beyond.max() > _BEYOND:
            joint = int(beyond.argmax())
            turns = model.chain.revolute[joint]
            far = f"{np.degrees(beyond[joint]):.0f}°" if turns else f"{beyond[joint]:.2g} m"
            motion = f"{names[joint]} moves {far} beyond its range"
        elif speed.max() > _OVER:
            joint = int(speed.argmax())
            motion = f"{names[joint]} moves at {speed[joint]:.3g} times its largest speed"
        expected = Size.of(cell, model, samples)
        factor = expected.factor or 1.0
        # A factor of 1000 is another unit, which a look names.
        if effort.max() > _OVER and not expected.is_thousand:
            joint = int(effort.argmax())
            size = f"the torque of {names[joint]} reaches {effort[joint]:.3g} times its limit"
        elif expected.is_off and factor > 1.0 and not expected.is_thousand:
            size = f"the torque is {factor:.2g} times that of {expected.basis}"
        if error > _UNEXPLAINED:
            torque = f"{percentage(error)} of the torque stays unexplained, whatever the masses"
        several = len(changed) > 1
        axes = f"the torque follows it with other {' and '.join(changed)} only" if several else ""
        return cls(motion, size, torque, axes)

    @property
    def sentences(self) -> tuple[str, ...]:
        """The contradictions there are."""
        return tuple(filter(None, (self.motion, self.size, self.torque, self.axes)))


def _largest(values: Array) -> Array:
    return np.asarray(np.quantile(np.abs(values), _MOST, axis=0))
