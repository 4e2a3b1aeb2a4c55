"""What an incomplete model costs each method of a study, by plain least squares without noise.

Run with ``python -m benchmarks.incomplete_model STUDY``, the folder of a `hil study`. The first
designs of each method are fitted along their planned motions by the law of the paper to a torque
that this law does not have, by pinocchio, and the fit predicts held-out motions of the study. Then
the law has the missing term. It uses neither the simulated arm nor the estimator of the study.

- **load**: dry friction of 5 % of the torque of the bodies;
- **delay**: the torque comes 0.5 ms late;
- **constants**: torque constants are wrong by 3 %, with different signs.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from hil.cell import Cell
from hil.design.design import DesignFolder
from hil.design.result import DesignResult
from hil.study.campaigns import fly_bys, sines
from hil.study.settings import study_settings
from identification.model.motion import Motion
from sim_fixtures.ns16 import CELL_PATH

Array = NDArray[np.float64]
METHODS: Final = ("a", "b", "gradient")
_PERIOD: Final = 0.01  # s
_ENDS: Final = 0.3  # s at both ends, which are left out
_SLOW: Final = 0.05  # of the largest speed, below which rows are left out
_SIGNS: Final = np.array([1.0, -1.0, 1.0, 1.0, -1.0, -1.0])


@dataclass(frozen=True, eq=False)
class Along:
    """A motion at m instants of an arm with n joints and p parameters.

    Attributes:
        rows: regressor (m, n, p).
        bodies: torque of the bodies (m, n).
        velocity, acceleration: (m, n).
        used: rows that count (m, n).
    """

    rows: Array
    bodies: Array
    velocity: Array
    acceleration: Array
    used: NDArray[np.bool_]


Missing = Callable[[Along], Array]
MISSING: Final[Mapping[str, tuple[float | Array, Missing]]] = {
    "load": (0.05, lambda motion: np.abs(motion.bodies) * np.sign(motion.velocity)),
    "delay": (-0.5e-3, lambda motion: np.gradient(motion.bodies, _PERIOD, axis=0)),
    "constants": (0.03 * _SIGNS, lambda motion: motion.bodies),
}
"""Size of what is missing, and its course for a size of one."""


def along(cell: Cell, trajectory: Any) -> Along:
    """Return a motion of the arm of a cell."""
    instants = np.arange(_ENDS, trajectory.duration - _ENDS, _PERIOD)
    states = [np.asarray(each) for each in trajectory.sample(instants)]
    model = pin.buildModelFromXML(cell.urdf)
    data = model.createData()
    bodies = np.array([pin.rnea(model, data, *state) for state in zip(*states, strict=True)])
    rows = cell.model.regressor(Motion.of_states(*states)).dense(cell.model.n_parameters)
    speed = np.abs(states[1])
    return Along(rows, bodies, states[1], states[2], speed > _SLOW * speed.max(axis=0))


def equations(motion: Along, term: str, scale: Array, *, known: bool) -> tuple[Array, Array]:
    """Return rows and missing torque by joint, over the torque of each; with the `known` term."""
    size, course = MISSING[term]
    shape = course(motion)
    rows = []
    sides = []
    for joint in range(shape.shape[1]):
        used = motion.used[:, joint]
        own = np.zeros((np.count_nonzero(used), shape.shape[1] if known else 0))
        if known:
            own[:, joint] = shape[used, joint]
        rows.append(np.hstack([motion.rows[used, joint], own]) / scale[joint])
        sides.append((size * shape)[used, joint] / scale[joint])
    return np.vstack(rows), np.concatenate(sides)


def error(
    design: Along, held_out: Sequence[Along], term: str, scale: Array, *, known: bool
) -> float:
    """Return the error on held-out motions, as a share of the torque of the bodies."""
    rows, side = equations(design, term, scale, known=known)
    length = np.maximum(np.linalg.norm(rows, axis=0), 1e-12)
    found = np.linalg.lstsq(rows / length, side, rcond=1e-7)[0] / length
    squares = 0.0
    torque = 0.0
    for motion in held_out:
        rows, side = equations(motion, term, scale, known=known)
        squares += float(np.sum((side - rows @ found) ** 2))
        torque += float(np.sum((motion.bodies / scale)[motion.used] ** 2))
    return float(np.sqrt(squares / torque))


def best_of(folder: Path, method: str) -> Any:
    """Return the motion of a search with its best choice."""
    results = [
        DesignResult.load(DesignFolder(place).result)
        for place in sorted(folder.iterdir())
        if DesignFolder(place).result.exists()
    ]

    def score(result: DesignResult) -> float:
        criteria = result.excitation.criteria
        return criteria.log10_det if method == "a" else criteria.fitness

    return max(results, key=score).excitation.trajectory


def main() -> None:
    """Print the error of each method as a ratio to method A."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("study", type=Path)
    parser.add_argument("--designs", type=int, default=10, help="of each method")
    parser.add_argument("--motions", type=int, default=15, help="held-out ones of each class")
    options = parser.parse_args()
    cell = Cell.load(CELL_PATH)
    settings = study_settings(quick=False, seed=1)
    classes = {
        "fly-by": [along(cell, each.trajectory) for each in fly_bys(cell, settings)],
        "sines": [along(cell, each.trajectory) for each in sines(cell, settings)],
    }
    held_out = {name: motions[: options.motions] for name, motions in classes.items()}
    every = [motion for motions in held_out.values() for motion in motions]
    scale = np.sqrt(np.mean([np.mean(motion.bodies**2, axis=0) for motion in every], axis=0))
    designs = {
        method: [
            along(cell, best_of(options.study / "designs" / f"{method}-{number:02d}", method))
            for number in range(options.designs)
        ]
        for method in METHODS
    }
    for method, motions in designs.items():
        size = np.sqrt(np.mean([np.mean(motion.acceleration**2) for motion in motions]))
        print(f"{method}: acceleration {size:.1f} rad/s² RMS")
    for term in MISSING:
        for known in (False, True):
            law = "with the term" if known else "without it"
            for name, motions in held_out.items():
                errors = {
                    method: np.mean([error(one, motions, term, scale, known=known) for one in own])
                    for method, own in designs.items()
                }
                figures = ", ".join(f"{method} {100 * one:.2f} %" for method, one in errors.items())
                print(f"{term}, law {law}, {name}: {figures}", flush=True)


if __name__ == "__main__":
    main()
