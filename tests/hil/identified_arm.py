"""An arm of any description, moved and identified in memory: what exports are made of."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.base.files import write_files
from hil.cell import Cell
from hil.pipeline.estimating import posterior_of
from hil.report.output_files import Exports, exports_of
from identification import Estimate
from identification.estimators.covariance import with_block_covariance
from identification.factor.estimate import estimate, joint_weights
from identification.factor.factor import Factor
from identification.selection.essential import Elimination, choose_essential
from identification.selection.settings import Strength
from identification.validation.consistency import ConsistencyCheck, check_consistency
from tests.identification.two_link import simulated, sine_motion, values_of

Array = NDArray[np.float64]

TWO_LINK = (Path(__file__).parents[1] / "identification" / "two_link.urdf").read_text()
CELL = '[cell]\nname = "arm"\nurdf = "arm.urdf"\n[robot]\n{robot}\n'


@dataclass(frozen=True)
class IdentifiedArm:
    """A cell and what was found of it.

    Attributes:
        truth: parameters (p,) that made the torques.
        estimate: by weighted least squares.
    """

    cell: Cell
    truth: Array
    estimate: Estimate
    consistency: ConsistencyCheck
    essential: Elimination


def write_exports(folder: Path, *args: Any, **kwargs: Any) -> Exports:
    """Write what `exports_of` makes of the arguments."""
    exports = exports_of(*args, **kwargs)
    write_files(folder, exports.contents)
    return exports


def packaged_urdf(name: str) -> str:
    """Text of a description in the package example-robot-data, or a skip."""
    files = metadata.files("example-robot-data") or ()
    path = next((str(file.locate()) for file in files if file.name == name), None)
    if path is None:
        pytest.skip(f"the package example-robot-data, which has {name}, is not installed")
    return Path(path).read_text(encoding="utf-8")


def identified_arm(
    urdf: str,
    robot: str = "",
    *,
    still: tuple[int, ...] = (),
    standard: Array | None = None,
    noise: float = 0.01,
) -> IdentifiedArm:
    """Move an arm of a description and identify it.

    Args:
        urdf: text.
        robot: lines of the cell's table [robot].
        still: joints, from 0, that do not move.
        standard: parameters (s,) that make the torques, by default nominal ones with rotors.
        noise: of the torque, as a share of each joint's.
    """
    cell = Cell.from_texts(CELL.format(robot=robot), urdf, Path("cell.toml"))
    model = cell.model
    friction = [{"f0": 2.0, "f1": 1.5, "fo": 0.1}.get(t.symbol, 0.3) for t in model.friction.terms]
    if standard is None:
        truth = values_of(model, friction, 0.2)
    else:
        truth = np.concatenate([model.base.grouping @ standard, friction])
    runs = [_run(cell, truth, seed, still, noise) for seed in (1, 2, 3)]
    training, *held_out = (Factor.by_time(model, run) for run in runs)
    weights = joint_weights(training)
    free = with_block_covariance(estimate(model, training, weights), training, weights)
    unseen = sum(held_out, Factor.zero(model))
    posterior = posterior_of(cell, training, "auto", Strength())
    consistency = check_consistency(
        model,
        training,
        unseen,
        posterior.free(training).estimate,
        weights=posterior.weights(training),
        prior=posterior.prior,
        design_effect=posterior.design_effect,
    )
    essential = choose_essential(model, training, held_out)
    return IdentifiedArm(cell, truth, free, consistency, essential)


def _run(cell, truth, seed, still, noise):
    model = cell.model
    motion = a_motion(model.n_joints, seed, still)
    size = np.sqrt(np.mean(model.torque(truth, motion) ** 2, axis=0))
    return simulated(model, truth, motion, noise * size, seed)


def a_motion(n, seed, still=()):
    """Eight seconds of three sines per joint."""
    rng = np.random.default_rng(seed)
    ranges = ((0.2, 0.5), (1, 5), (0, 6))
    size, pulse, phase = (rng.uniform(low, high, (3, n)) for low, high in ranges)
    size[:, list(still)] = 0.0
    return sine_motion(np.arange(0.0, 8.0, 0.01), size, pulse, phase)
