"""Designs that count what earlier recordings know."""

from __future__ import annotations

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.base.errors import ArchiveError, InputError
from hil.base.progress import Silent
from hil.campaign import design
from hil.cell import Cell
from hil.cli import app
from hil.design import load_design, load_settings, preset, problem_of
from hil.precision.given_recordings import given_of
from identification.excitation import Objective, midpoints
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.conftest import run_campaign, small

pytestmark = pytest.mark.long

SETTINGS = """\
method = "gradient"
[search]
population = 8
generations = 1
gradient = 1
[via_points]
n_via = 4
"""


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Two repetitions and a validation run, simulated."""
    cell = small(repetitions=2, validation_runs=1)
    return run_campaign(tmp_path_factory.mktemp("given") / "it", cell, design(cell, Silent()))


@pytest.fixture(scope="module")
def given(campaign):
    return given_of(campaign.cell, [campaign.folder.root])


def test_a_campaign_counts_with_its_repetitions(campaign, given):
    """The validation run is never fitted, so it does not count."""
    trajectory = campaign.plan.excitation.trajectory
    np.testing.assert_allclose(given.duration, 2 * trajectory.duration, rtol=0.02)
    motion = midpoints(trajectory)
    planned = Objective(campaign.cell.model).information(motion) / motion.n_samples
    scale = np.sqrt(np.diag(planned))
    assert np.max(np.abs((given.mean - planned) / scale / scale[:, None])) < 0.05


def test_the_same_motion_again_has_the_same_criteria(campaign, given):
    """Criteria are of an average sample: the same motion once more changes neither."""
    trajectory = campaign.plan.excitation.trajectory
    model = campaign.cell.model
    alone = Objective(model).criteria(trajectory, 0.008)
    planned = Objective(model).information(midpoints(trajectory))
    exact = type(given)(planned / midpoints(trajectory).n_samples, 2 * trajectory.duration)
    both = Objective(model, given=exact).criteria(trajectory, 0.008)
    np.testing.assert_allclose(both.measures, alone.measures, rtol=1e-6)
    assert both.n_samples == alone.n_samples


def test_archives_of_another_arm_are_refused(campaign):
    other = Cell.load(CELL_PATH).with_values({"robot.rotor_inertia": False})
    with pytest.raises(InputError, match=r"belongs to another arm .*\[robot\]"):
        given_of(other, [campaign.folder.root])


def test_a_design_counts_all_recordings_together(campaign, given, tmp_path):
    """And the settings of its file name them, so that a design from it counts them again."""
    (tmp_path / "my.toml").write_text(SETTINGS)
    out = tmp_path / "out"
    arguments = ["design", str(CELL_PATH), "--settings", str(tmp_path / "my.toml"), "--limits-only"]
    arguments += ["--given", str(campaign.folder.root), "-o", str(out), "--workers", "1"]
    result = CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert f"{given.duration:.3g} s of motion in the given recordings" in result.output
    excitation = load_design(out)
    expected = Objective(campaign.cell.model, given=given).criteria(excitation.trajectory, 0.001)
    np.testing.assert_allclose(excitation.criteria.measures, expected.measures, rtol=1e-9)
    named = load_settings(out / "excitation.toml").objective.given
    assert named == [str(campaign.folder.root)]


def test_settings_that_name_recordings_need_their_information():
    settings = preset("gradient").replaced(objective={"given": ["runs/mine"]})
    with pytest.raises(InputError, match=r"objective.given: .*given_of"):
        problem_of(Cell.load(CELL_PATH), settings)


@pytest.mark.parametrize("name", ["nothing.mcap", "text.mcap"])
def test_no_archive_is_refused_before_the_search(name, tmp_path):
    (tmp_path / "text.mcap").write_text("no archive")
    arguments = [
        "design",
        str(CELL_PATH),
        "--given",
        str(tmp_path / name),
        "-o",
        str(tmp_path / "o"),
    ]
    with pytest.raises(ArchiveError, match=name):
        CliRunner().invoke(app, arguments, catch_exceptions=False)
    assert not (tmp_path / "o").exists()
