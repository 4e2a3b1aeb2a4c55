"""Time of regressor and Gram matrix: ours against a loop over pinocchio, in one run.

Run with ``python -m benchmarks.regressor [--json]``: 16 000 samples of the NS 16 (6 joints).

- ours: 58 columns (40 base, 18 friction) and the torque, reduced per joint to its Gram matrix;
- pinocchio: ``computeJointTorqueRegressor`` sample by sample into one array, then the dense Gram
  matrix of its 96 000 x 60 rows. That is less than ours makes: no friction, rotors or torque.

Both use one thread, whose processor time counts. The repetitions alternate, and medians are
compared; so are the Gram matrices, on the columns that both have.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from benchmarks import parser_of, show, timed
from identification import Factor, Motion, RobotModel
from identification.model.kinematics import PINOCCHIO_ORDER
from identification.model.link_wrenches import LINK_SYMBOLS

Array = NDArray[np.float64]

SAMPLES = 16_000
REPETITIONS = 25
URDF = Path(__file__).resolve().parents[1] / "sim_fixtures" / "ns16" / "ns16.urdf"


def sine_motion(n_joints: int) -> Motion:
    """Return a smooth motion of 16 s at 1 kHz: three sines per joint."""
    random = np.random.default_rng(1)
    t = np.arange(SAMPLES, dtype=np.float64) * 1e-3
    frequency = random.uniform(0.5, 6.0, (3, n_joints))
    amplitude = random.uniform(0.1, 0.6, (3, n_joints))
    phase = t[:, None, None] * frequency
    return Motion(
        t,
        (amplitude * np.sin(phase)).sum(axis=1),
        (amplitude * frequency * np.cos(phase)).sum(axis=1),
        (-amplitude * frequency**2 * np.sin(phase)).sum(axis=1),
    )


def pinocchio_gram(model: pin.Model, motion: Motion, stacked: Array) -> Array:
    """Return the Gram matrix of pinocchio's stacked regressor, shape (60, 60)."""
    data = model.createData()
    regressor = pin.computeJointTorqueRegressor
    for sample, (q, qd, qdd) in enumerate(motion.states()):
        stacked[sample] = regressor(model, data, q, qd, qdd)
    rows = stacked.reshape(-1, 10 * model.nv)
    return rows.T @ rows


def common_columns(model: RobotModel) -> tuple[list[int], list[int]]:
    """Return columns of ours, and the columns of pinocchio's that are the same parameters."""
    width = len(LINK_SYMBOLS) + model.layout.rotor_inertia
    columns: list[int] = []
    foreign: list[int] = []
    for column, standard in enumerate(model.base.pivots):
        joint, symbol = divmod(int(standard), width)
        if symbol < len(LINK_SYMBOLS):
            columns.append(column)
            foreign.append(10 * joint + PINOCCHIO_ORDER[symbol])
    return columns, foreign


def _difference(model: RobotModel, ours: Array, theirs: Array) -> float:
    """Return the largest difference of the two Gram matrices, columns scaled to unit length."""
    columns, foreign = common_columns(model)
    a = ours[np.ix_(columns, columns)]
    b = theirs[np.ix_(foreign, foreign)]
    length = np.sqrt(np.diag(b))
    return float(np.max(np.abs(a - b) / length / length[:, None]))


def main() -> None:
    """Measure, and print the figures."""
    options = parser_of(__doc__).parse_args()

    urdf = URDF.read_text(encoding="utf-8")
    model = RobotModel.from_urdf(urdf)
    reference = pin.buildModelFromXML(urdf)
    motion = sine_motion(model.n_joints)
    torque = model.torque(np.ones(model.n_parameters), motion)

    def ours() -> Array:
        total: Array = Factor.from_samples(model, motion, torque).gram.sum(axis=0)
        return total

    # Memory is made once for either side: ours keeps its working arrays between calls.
    stacked = np.zeros((SAMPLES, reference.nv, 10 * reference.nv))

    def theirs() -> Array:
        return pinocchio_gram(reference, motion, stacked)

    difference = _difference(model, ours(), theirs())
    times = np.array([(timed(ours), timed(theirs)) for _ in range(REPETITIONS)])
    ours_ms, pinocchio_ms = (float(value) * 1e3 for value in np.median(times, axis=0))
    result = {
        "ratio_to_pinocchio": round(pinocchio_ms / ours_ms, 3),
        "ours_ms": round(ours_ms, 3),
        "pinocchio_ms": round(pinocchio_ms, 3),
        "columns": model.n_parameters,
        "samples": SAMPLES,
        "repetitions": REPETITIONS,
        "clock": "processor time of one thread",
        "gram_difference": difference,
    }
    show(result, only_json=options.json)


if __name__ == "__main__":
    main()
