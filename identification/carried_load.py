"""Whether an error on unseen motion is that of a body the arm carries there and did not before."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from identification.model import RobotModel
from identification.standard_gram import StandardGram, solve, squared_errors
from identification.wrench import LINK_SYMBOLS

Array = NDArray[np.float64]

# A joint's error is beyond that of the fit if its power is this many times larger.
_GROWN: Final = 4.0


@dataclass(frozen=True)
class CarriedLoad:
    """A body on the last link that the unseen motion asks for and the fitted one does not.

    Attributes:
        mass: how much more the arm carried there [kg].
        explained: share of the error on unseen motion, beyond that of the fit, that it explains.
        axes: number of joints whose error is far beyond that of the fit.
    """

    mass: float
    explained: float
    axes: int


def find_load(model: RobotModel, training: StandardGram, held_out: StandardGram) -> CarriedLoad:
    """Fit the training motion, and then ten more parameters of the last link to the unseen one."""
    seen, unseen = training.under(model.gravity), held_out.under(model.gravity)
    power = np.maximum(seen[:, -1, -1], 1e-300)
    values = solve(seen, training.rows / power)
    # The error of the fit in as many rows as were predicted.
    floor = 1e-12 * unseen[:, -1, -1] + 1e-300
    share = held_out.rows / np.maximum(training.rows, 1.0)
    usual = squared_errors(seen, values) * share
    weights = held_out.rows / np.maximum(usual, floor)
    before = squared_errors(unseen, values)
    last = model.layout.links[-1]
    n, k = len(unseen), len(last)
    # Of [last link | what the fit leaves over].
    gram = np.empty((n, k + 1, k + 1))
    gram[:, :k, :k] = unseen[:, last[:, None], last[None, :]]
    gram[:, :k, k] = unseen[:, last, -1] - unseen[:, last, :-1] @ values
    gram[:, k, :k] = gram[:, :k, k]
    gram[:, k, k] = before
    body = solve(gram, weights)
    after = squared_errors(gram, body)
    beyond = weights @ np.maximum(before - usual, 0.0)
    return CarriedLoad(
        mass=float(body[LINK_SYMBOLS.index("m")]),
        explained=float(weights @ (before - after) / beyond) if beyond > 0.0 else 0.0,
        axes=int(np.count_nonzero(before > _GROWN * np.maximum(usual, floor))),
    )
