"""Errors on one side only, simulated arm or PC, make the verdict wrong.

The simulated arm differs from what its controller reports and the cell file states, or the PC
misinterprets correct archives. Also the true parameters of the simulation: friction laws and errors
of the URDF.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import hil.pipeline.sources
from hil.archive.recording_of_archive import recording_of
from hil.base.progress import Silent
from hil.campaign import CampaignPlan
from hil.campaign.identified_campaign import identify_campaign
from hil.cell import Cell, CellError
from hil.control.planted_arm import planted_truth, planted_values
from hil.control.simulated_cell import simulated_controller, simulated_drive
from identification.model.friction import COULOMB
from sim_fixtures.ns16 import CELL_PATH, load_truth, urdf_text
from tests.sim_fixtures.bench import base_from_standard, standard_parameters

pytestmark = pytest.mark.long

slow = pytest.mark.slow


@pytest.fixture(scope="module")
def ran(tmp_path_factory, cell, plan, run):
    """Return a function that runs a short campaign, one motion of each kind."""
    short = cell.with_link(cycle_ms=2).with_campaign(repetitions=2, validation_runs=1)
    motions = CampaignPlan(plan.excitation, plan.validation[:1])

    def campaign(error=None, **changes):
        if error is not None:
            changes["drive"] = error(simulated_drive(short))
        return run(tmp_path_factory.mktemp("ran") / "campaign", short, motions, **changes)

    return campaign


@pytest.fixture(scope="module")
def correct_campaign(ran):
    """Return a campaign of the robot that the cell describes; read only."""
    return ran()


def verdict(campaign):
    return identify_campaign(campaign.folder.root, Silent()).results.verdict


def swapped(values, i, j):
    exchanged = list(values)
    exchanged[i], exchanged[j] = exchanged[j], exchanged[i]
    return tuple(exchanged)


ERRORS = {
    "gear 4 negated": lambda drive: replace(
        drive, gear_ratio=tuple(np.multiply(drive.gear_ratio, [1, 1, 1, -1, 1, 1]).tolist())
    ),
    "coupling of 5 into 6 turned": lambda drive: replace(drive, k65=-drive.k65),
    "torque constants of 2 and 3 swapped": lambda drive: replace(
        drive, torque_constant=swapped(drive.torque_constant, 1, 2)
    ),
}


def test_a_correct_cell_is_good(correct_campaign):
    judged = verdict(correct_campaign)
    assert judged.good, judged.line


@slow
def test_usual_unmodelled_effects_stay_good(ran):
    judged = verdict(ran(effects=True))
    assert judged.good, judged.line


@pytest.mark.parametrize(
    "error",
    [
        *(pytest.param(name, marks=slow) for name in [*ERRORS][:2]),
        "torque constants of 2 and 3 swapped",
    ],
)
def test_a_robot_other_than_the_cell_is_wrong(ran, error):
    judged = verdict(ran(ERRORS[error]))
    assert not judged.good, judged.line


@pytest.mark.parametrize("joint", [0, *(pytest.param(joint, marks=slow) for joint in range(1, 6))])
def test_a_negative_torque_constant_is_wrong(correct_campaign, monkeypatch, joint):
    def turned(archive):
        recording = recording_of(archive)
        signs = np.where(np.arange(recording.n_joints) == joint, -1.0, 1.0)
        return replace(recording, torque=recording.torque * signs)

    monkeypatch.setattr(hil.pipeline.sources, "recording_of", turned)
    judged = verdict(correct_campaign)
    assert not judged.good, judged.line


def test_negated_friction_columns_are_wrong(correct_campaign, monkeypatch):
    """The prediction is equal, but negative friction is impossible."""
    monkeypatch.setitem(vars(COULOMB), "value", lambda v, s, _: -s)
    judged = verdict(correct_campaign)
    assert not judged.good, judged.line
    assert any("Coulomb friction of" in reason for reason in judged.reasons)


LAWS = {"joint_1": "quadratic", "joint_2": "cubic"}


def truth_with(laws, planted):
    """Return the truth of the NS 16 with third terms of some joints and these coefficients."""
    base = Cell.load(CELL_PATH).with_values({"simulation.third": planted})
    lines = [f'[robot.friction.joints.{name}]\nthird = "{law}"' for name, law in laws.items()]
    text = base.text.replace('third = "quadratic"', 'third = "none"', 1)
    return planted_truth(Cell.from_texts("\n".join([text, *lines]), base.urdf, base.path))


def test_the_law_follows_the_simulated_third_term():
    """Joints without a third term do not count; two laws in one arm raise."""
    for laws in ({"joint_2": "quadratic"}, {"joint_2": "cubic"}, LAWS):
        assert truth_with(laws, [0, 1.5, 0, 0, 0, 0]).third_law == laws["joint_2"]
    with pytest.raises(CellError, match=r"robot\.friction\.joints.*joint_1, joint_2.*same third"):
        truth_with(LAWS, [1, 1.5, 0, 0, 0, 0])


class TestInertiaScale:
    """The arm has scaled links, the PC those of the URDF."""

    def test_the_demo_has_table_2_and_other_nominal_values(self):
        cell = Cell.load(CELL_PATH)
        table = base_from_standard(standard_parameters())
        planted = planted_values(cell)
        nominal = cell.nominal_values()
        b = cell.model.base.rank
        large = np.abs(planted) > 1e-6
        # Table 2 has other signs and another order.
        sizes = np.sort(np.abs(planted[:b]))
        printed = np.sort(np.abs(table))
        np.testing.assert_allclose(sizes, printed, rtol=1e-9, atol=1e-12)
        errors = np.abs(nominal[large] / planted[large] - 1.0)
        assert errors.max() < 0.25
        assert np.median(errors) > 0.1

    def test_the_controller_moves_the_simulated_arm(self):
        moved = simulated_controller(Cell.load(CELL_PATH)).plant.model
        bodies, planted = (
            [body.toDynamicParameters() for body in list(model.inertias)[1:]]
            for model in (moved, pin.buildModelFromXML(urdf_text()))
        )
        np.testing.assert_allclose(bodies, planted, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(moved.armature, load_truth().rotor_inertia, rtol=1e-11)

    def test_without_it_the_urdf_is_true(self):
        cell = Cell.load(CELL_PATH).with_values({"simulation.inertia_scale": []})
        b = cell.model.base.rank
        standard = cell.model.nominal
        np.testing.assert_array_equal(planted_truth(cell).inertia_scale, np.ones(6))
        standard[cell.model.layout.rotors] = cell.simulation.rotor_inertia
        np.testing.assert_allclose(planted_values(cell)[:b], cell.model.base.grouping @ standard)
        for scale in ([1.1], [1.0, 1.0, 1.0, 1.0, 1.0, 0.0]):
            with pytest.raises(CellError, match=r"simulation\.inertia_scale"):
                cell.with_values({"simulation.inertia_scale": scale})
