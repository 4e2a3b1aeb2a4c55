"""Errors on one side only, simulated arm or PC, make the verdict wrong.

The simulated arm differs from what its controller reports and the cell file states, or the PC
misinterprets correct archives. Also the true parameters of the simulation: friction laws and errors
of the URDF.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

import hil.identify.sources
from hil.campaign import Campaign, CampaignPlan
from hil.cell import Cell, CellError
from hil.identify import identify_campaign
from hil.progress import Silent
from hil.recordings import recording_of
from hil.simulation import planted_truth, planted_values, simulated_controller, simulated_drive
from identification.model.friction import COULOMB
from sim_fixtures.ns16 import (
    CELL_PATH,
    base_from_standard,
    load_truth,
    standard_parameters,
    urdf_text,
)

Run = Callable[..., Campaign]


@pytest.fixture(scope="module")
def short(cell):
    return cell.with_link(cycle_ms=2).with_campaign(repetitions=2, validation_runs=1)


@pytest.fixture(scope="module")
def motions(plan):
    """Return one motion of each kind."""
    return CampaignPlan(plan.excitation, plan.validation[:1])


@pytest.fixture(scope="module")
def correct_campaign(tmp_path_factory, short, motions, run):
    """Return a campaign of the robot that the cell describes; read only."""
    return run(tmp_path_factory.mktemp("correct_campaign") / "campaign", short, motions)


def verdict(campaign):
    return identify_campaign(campaign.folder.root, Silent()).results.verdict


def gear_4_negated(drive):
    ratios = list(drive.gear_ratio)
    ratios[3] = -ratios[3]
    return replace(drive, gear_ratio=tuple(ratios))


def coupling_of_5_into_6_turned(drive):
    return replace(drive, k65=-drive.k65)


def torque_constants_of_2_and_3_swapped(drive):
    constants = list(drive.torque_constant)
    constants[1], constants[2] = constants[2], constants[1]
    return replace(drive, torque_constant=tuple(constants))


def test_a_correct_cell_is_good(correct_campaign):
    found = verdict(correct_campaign)
    assert found.good, found.line


@pytest.mark.slow
def test_usual_unmodelled_effects_stay_good(tmp_path, short, motions, run):
    found = verdict(run(tmp_path / "effects", short, motions, effects=True))
    assert found.good, found.line


@pytest.mark.parametrize(
    "error",
    [
        pytest.param(gear_4_negated, marks=pytest.mark.slow),
        pytest.param(coupling_of_5_into_6_turned, marks=pytest.mark.slow),
        torque_constants_of_2_and_3_swapped,
    ],
    ids=lambda error: error.__name__,
)
def test_a_robot_other_than_the_cell_is_wrong(tmp_path, short, motions, run, error):
    physical = error(simulated_drive(short))
    found = verdict(run(tmp_path / "tampered", short, motions, drive=physical))
    assert not found.good, found.line


@pytest.mark.parametrize(
    "joint", [0, *(pytest.param(joint, marks=pytest.mark.slow) for joint in range(1, 6))]
)
def test_a_negative_torque_constant_is_wrong(correct_campaign, monkeypatch, joint):
    def turned(archive):
        recording = recording_of(archive)
        signs = np.where(np.arange(recording.n_joints) == joint, -1.0, 1.0)
        return replace(recording, torque=recording.torque * signs)

    monkeypatch.setattr(hil.identify.sources, "recording_of", turned)
    found = verdict(correct_campaign)
    assert not found.good, found.line


def test_negated_friction_columns_are_wrong(correct_campaign, monkeypatch):
    """The prediction is equal, but negative friction is impossible."""
    monkeypatch.setitem(vars(COULOMB), "value", lambda v, s, _: -s)
    found = verdict(correct_campaign)
    assert not found.good, found.line
    assert any("Coulomb friction of" in reason for reason in found.reasons)


def cell_with(third, overrides, planted):
    """Return the NS 16 with these third laws and true coefficients."""
    base = Cell.load(CELL_PATH).with_values({"simulation.third": json.loads(planted)})
    lines = [f'[robot.friction.joints.{name}]\nthird = "{law}"' for name, law in overrides.items()]
    text = base.text.replace('third = "quadratic"', f'third = "{third}"', 1)
    return Cell.from_texts("\n".join([text, *lines]), base.urdf, base.path)


@pytest.mark.parametrize(
    ("laws", "found"),
    [
        ({"joint_2": "quadratic"}, "quadratic"),
        ({"joint_2": "cubic"}, "cubic"),
        ({"joint_1": "quadratic", "joint_2": "cubic"}, "cubic"),
    ],
)
def test_the_law_follows_the_simulated_third_term(laws, found):
    """Joints without a third term do not count; two laws in one arm raise."""
    assert planted_truth(cell_with("none", laws, "[0, 1.5, 0, 0, 0, 0]")).third_law == found
    cell = cell_with("none", {"joint_1": "quadratic", "joint_2": "cubic"}, "[1, 1.5, 0, 0, 0, 0]")
    with pytest.raises(CellError, match=r"robot\.friction\.joints.*joint_1, joint_2.*same third"):
        planted_truth(cell)


class TestInertiaScale:
    """The arm has scaled links, the PC those of the URDF."""

    def test_the_demo_has_table_2_and_other_nominal_values(self):
        cell = Cell.load(CELL_PATH)
        table = base_from_standard(standard_parameters())
        planted, known = planted_values(cell), cell.nominal_values()
        b = cell.model.base.rank
        large = np.abs(planted) > 1e-6
        # Table 2 has other signs and another order.
        found, printed = np.sort(np.abs(planted[:b])), np.sort(np.abs(table))
        np.testing.assert_allclose(found, printed, rtol=1e-9, atol=1e-12)
        errors = np.abs(known[large] / planted[large] - 1.0)
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
        np.testing.assert_array_equal(planted_truth(cell).inertia_scale, np.ones(6))
        rotors = np.array(cell.simulation.rotor_inertia)
        standard = cell.model.nominal
        standard[cell.model.layout.rotors] = rotors
        np.testing.assert_allclose(planted_values(cell)[:b], cell.model.base.grouping @ standard)

    @pytest.mark.parametrize("scale", [[1.1], [1.0, 1.0, 1.0, 1.0, 1.0, 0.0]])
    def test_one_positive_factor_per_joint_is_needed(self, scale):
        with pytest.raises(CellError, match=r"simulation\.inertia_scale"):
            Cell.load(CELL_PATH).with_values({"simulation.inertia_scale": scale})
