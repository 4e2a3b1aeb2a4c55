"""A rehearsal of an arm with seven joints, two of whose main axes are almost parallel."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.campaign import Campaign, design
from hil.campaign.rehearsal_twin import FASTEST, Twin
from hil.cell import Cell
from hil.cli import app
from hil.progress import Silent
from sim_fixtures.elastic_plant import ElasticPlant
from sim_fixtures.truth import PlantTruth
from tests.hil.new_cells import described_robot, filled_in

HOME = [0.0, -30.0, 0.0, -120.0, 0.0, 90.0, 0.0]
FOUR, THREE = [2.0] * 4, [1.0] * 3


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    """The Panda, as `hil new` writes it, with the figures that nobody published."""
    path = tmp_path_factory.mktemp("seven") / "cell.toml"
    urdf = described_robot("panda_description/urdf/panda.urdf")
    CliRunner().invoke(app, ["new", "--urdf", str(urdf), "-o", str(path)], catch_exceptions=False)
    path.write_text(
        filled_in(
            path, 7, campaign__home_deg=HOME, workspace__margin=0.002, limits__torque=[],
            limits__lower_deg=[angle - 50.0 for angle in HOME],
            limits__upper_deg=[angle + 40.0 for angle in HOME],
            limits__velocity_deg=[120.0] * 7, limits__acceleration_deg=[500.0] * 7,
            limits__jerk_deg=[8000.0] * 7,
            nominal__rotor_inertia=[0.6, 0.6, 0.5, 0.5, 0.2, 0.2, 0.2],
            nominal__coulomb=FOUR + THREE, nominal__viscous=FOUR + THREE,
        )
    )  # fmt: skip
    return Cell.load(path).with_campaign(repetitions=3, validation_runs=2)


def test_springs_of_the_twin_suit_an_arm_whose_axes_carry_each_other(cell: Cell) -> None:
    """The plant itself, without gravity, friction and servo: energy put into the springs stays."""
    given = Twin.of(cell, seed=1, repetitions=1).cell.file.simulation
    assert given is not None
    compliance, none = np.array(given.elasticity), np.zeros(7)
    assert (compliance[:3] > 0.0).all() and not compliance[3:].any()
    step = 0.5 * cell.period
    assert FASTEST * step <= 1.0
    for angles in (HOME, [0.0, 0.0, 0.0, -90.0, 0.0, 40.0, 0.0]):
        plant = ElasticPlant(
            cell.urdf,
            PlantTruth(np.array(given.rotor_inertia), none, none, none),
            elasticity=compliance,
            gravity=np.zeros(3),
            position=np.radians(angles),
            step=step,
        )
        plant.step(np.full(7, 1.0), step)
        before = plant.energy()
        for _ in range(4000):
            plant.step(np.zeros(7), step)
        assert plant.energy() < 2.0 * before


@pytest.mark.slow
def test_a_good_plan_of_seven_joints_passes_every_criterion(cell: Cell, tmp_path: Path) -> None:
    campaign = Campaign.create(tmp_path / "campaign", cell, design(cell, Silent()))
    found = campaign.rehearse()
    assert found.passed, [one.sentence for one in found.criteria if not one.passed]
