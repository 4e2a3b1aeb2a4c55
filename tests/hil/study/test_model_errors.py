"""Errors of the model in a study, against the simulated arm that has them itself."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignPlan, Stop
from hil.campaign.plan import design
from hil.cell import Cell
from hil.control.planted_arm import planted_values
from hil.control.simulated_cell import simulated_link
from hil.study.estimates import low_passed, prepared_archives
from hil.study.model_errors import ALL, Condition, ErrorName, ModelErrors, PlannedTorque
from identification import Motion
from identification.excitation import sampled
from identification.signals.samples import Samples
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_cell

pytestmark = pytest.mark.long

Array = NDArray[np.float64]
NO_EFFECTS = {
    "simulation.torque_ripple": 0.0,
    "simulation.friction_drift": 0.0,
    "simulation.elasticity": [],
    "simulation.delay": 0.0,
}


@pytest.fixture(scope="module")
def ns16() -> tuple[Cell, CampaignPlan]:
    cell = Cell.load(CELL_PATH)
    cell = cell.with_values(
        {
            "campaign.repetitions": 1,
            "campaign.approach_speed": 1.0,
            "campaign.candidates": 12,
            "campaign.validation_runs": 1,
            "simulation.initial_deg": cell.campaign.home_deg,
        }
    )
    return cell, design(cell, Silent())


def simulated(root: Path, cell: Cell, plan: CampaignPlan) -> Samples:
    """A repetition of the excitation on an arm with the effects of its cell."""
    plan = CampaignPlan(plan.excitation, (), plan.moves)
    campaign = Campaign.create(root, cell, plan)
    link = simulated_link(cell, effects=True)
    campaign.run(link, Stop(), Silent(), durable=False, unrehearsed=True)
    return prepared_archives(root, "excitation").fitted[0]


@pytest.mark.parametrize(
    ("name", "effect", "size"),
    [
        ("elastic gears", "simulation.elasticity", 1),
        ("friction drift", "simulation.friction_drift", 1),
        ("delay", "simulation.delay", 2),  # once is about as large as the noise of the currents
    ],
)
def test_an_error_along_the_plan_is_what_the_simulated_arm_has(
    ns16: tuple[Cell, CampaignPlan], tmp_path: Path, name: ErrorName, effect: str, size: int
) -> None:
    """The first axis, where each is largest: what the true parameters leave there."""
    cell, plan = ns16
    alone = {key: none for key, none in NO_EFFECTS.items() if key != effect}
    if name == "delay":
        alone[effect] = size * cell.simulation.delay
    samples = simulated(tmp_path / "arm", cell.with_values(alone), plan)
    left = samples.torque - cell.model.torque(planted_values(cell), samples.motion)
    planned = PlannedTorque.of(cell, plan.excitation.trajectory)
    time = samples.motion.time - samples.origin
    nothing = np.zeros_like(left)
    added = ModelErrors(cell, 1).measured(Condition(name, size), nothing, planned, time, 0.0)
    usable = samples.usable[:, 0]
    ours, theirs = (low_passed(samples, one * samples.usable)[usable, 0] for one in (added, left))
    assert np.corrcoef(ours, theirs)[0, 1] > 0.8
    assert np.linalg.norm(ours) == pytest.approx(np.linalg.norm(theirs), rel=0.3)


@pytest.fixture
def small(tmp_path: Path) -> tuple[ModelErrors, PlannedTorque]:
    cell = fast_cell(tmp_path)
    return ModelErrors(cell, 1), PlannedTorque.of(
        cell, design(cell, Silent()).excitation.trajectory
    )


def change(small: tuple[ModelErrors, PlannedTorque], condition: Condition) -> Array:
    """What a condition adds to the torque of the gears along a plan, a cycle after it."""
    errors, plan = small
    time = plan.step * (1.0 + np.arange(len(plan.gear)))
    return np.asarray(errors.measured(condition, plan.gear, plan, time, 0.0) - plan.gear)


def test_torque_constants_are_wrong_by_three_per_cent(
    small: tuple[ModelErrors, PlannedTorque],
) -> None:
    """Without coupling of the motors each joint's torque is."""
    share = change(small, Condition("torque constants", 1))[10:-10] / small[1].gear[10:-10]
    np.testing.assert_allclose(np.abs(share), 0.03, rtol=1e-9)


def test_load_friction_is_a_share_of_the_load(
    small: tuple[ModelErrors, PlannedTorque],
) -> None:
    added = change(small, Condition("friction with load", 1))
    plan = small[1]
    np.testing.assert_allclose(added, 0.05 * np.abs(plan.gear) * np.sign(plan.velocity))


def test_stribeck_friction_is_that_of_slow_motion(
    small: tuple[ModelErrors, PlannedTorque],
) -> None:
    added = np.abs(change(small, Condition("Stribeck friction", 1)))
    speed = np.abs(small[1].velocity) / np.radians(400.0)
    assert added[speed > 0.3].max() < 1e-3 * added.max()
    slow = (speed > 0.0) & (speed < 0.005)
    expected = np.broadcast_to([1.2, 0.6], added.shape)[slow]  # a fifth of the Coulomb torques
    np.testing.assert_allclose(added[slow], expected, rtol=3e-3)


def test_lengths_are_wrong_in_the_fitted_model_alone(
    small: tuple[ModelErrors, PlannedTorque],
) -> None:
    errors = small[0]
    assert not change(small, Condition("link lengths", 2)).any()
    assert errors.fitted(Condition("delay", 2)) is errors.cell
    for condition, share in ((Condition("link lengths", 2), 0.002), (ALL, 0.001)):
        fitted = errors.fitted(condition)
        assert fitted.model.parameter_names == errors.cell.model.parameter_names
        motion = replace(small_motion(errors.cell), direction=None)
        values = planted_values(errors.cell)
        torques = [cell.model.torque(values, motion) for cell in (fitted, errors.cell)]
        assert 0.0 < np.abs(torques[0] - torques[1]).max() < 2.0 * share * np.abs(torques[1]).max()


def small_motion(cell: Cell) -> Motion:

    return sampled(design(cell, Silent()).excitation.trajectory)


@pytest.mark.parametrize(
    "name", ["friction drift", "Stribeck friction", "friction with load", "torque constants"]
)
def test_sizes_are_multiples(small: tuple[ModelErrors, PlannedTorque], name: str) -> None:
    once, twice = (change(small, Condition(name, size)) for size in (1, 2))
    np.testing.assert_allclose(twice, 2.0 * once, atol=1e-9)
