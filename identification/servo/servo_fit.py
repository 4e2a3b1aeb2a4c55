"""A fit of servos: the estimate, its terms, and the fitted windows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from identification.servo.fit import ServoEstimate


class Touch(NamedTuple):
    """A stretch in which something held or pushed the arm.

    Attributes:
        motion: index.
        start, end: from the start of the motion [s].
    """

    motion: int
    start: float
    end: float


@dataclass(frozen=True)
class TermChoice:
    """Whether a model of one joint has some terms, and what prediction says.

    Attributes:
        terms: names.
        joint: index.
        present: whether they are in the model.
        gain: by which they lower the root mean square of the prediction error, as a fraction of
            that without them.
        shown: whether windows that were not fitted are predicted better with them by more than
            chance, and not in one window alone.
    """

    terms: tuple[str, ...]
    joint: int
    present: bool
    gain: float
    shown: bool


@dataclass(frozen=True, eq=False)
class ServoFit:
    """An estimate, and how its terms were chosen.

    Attributes:
        estimate: of all windows.
        choices: of terms.
        windows: number of windows that were fitted.
        shown: whether prediction shows a parameter (n, P); true for parameters of every model.
        left_out: stretches of the motions in which something held or pushed the arm, whose windows
            were not fitted.
    """

    estimate: ServoEstimate
    choices: tuple[TermChoice, ...]
    windows: int
    shown: NDArray[np.bool_]
    left_out: tuple[Touch, ...]
