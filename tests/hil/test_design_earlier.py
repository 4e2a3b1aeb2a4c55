"""Sequential design: what earlier archives say joins what the new motion is going to say."""

from __future__ import annotations

import re
import tomllib

import numpy as np
import pytest
import typer
from matplotlib.figure import Figure
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.cell import Cell
from hil.cli.design import design
from hil.design import preset, problem_of
from hil.design.earlier import known_from
from hil.design.knowledge import Knowledge
from hil.errors import InputError
from hil.identify import identify_campaign
from hil.plots import design_picture
from hil.progress import Silent
from identification.excitation import sampled
from identification.factor import Factor


@pytest.fixture(scope="module")
def known(campaign, cell) -> Knowledge:
    return known_from([campaign.folder.root], cell, Silent())


def test_joints_count_by_the_noise_of_their_torque(known, campaign):
    pooled = identify_campaign(campaign.folder.root, Silent()).estimate.pooled
    np.testing.assert_allclose(known.joint_weights, 1.0 / pooled.noise_std**2)
    np.testing.assert_array_equal(known.values, pooled.values)
    np.testing.assert_array_equal(known.std, pooled.std)


def test_running_the_same_motion_again_says_about_the_same_again(known, campaign, cell, plan):
    # The archives hold a sample for each cycle of 1 ms, the search takes one every 8 ms. A fit
    # leaves out rows near standstill and reversals, where a measured velocity's sign says little.
    objective = problem_of(cell, preset("b").kinematic(), known).objective
    assert objective.repetitions == len(campaign.folder.completed("excitation")) == 3
    motion = sampled(plan.excitation.trajectory)
    moving = cell.model.moving(motion.velocity)
    factor = Factor.from_samples(cell.model, motion, np.zeros_like(motion.position), moving)
    share = np.diag(known.gram) / np.diag(objective.gram(factor))
    np.testing.assert_allclose(share, 0.5, atol=0.05)
    assert known.samples / objective.n_samples(motion.n_samples) == pytest.approx(0.5, abs=0.05)


def test_every_archive_is_recorded_with_its_checksum(known, campaign):
    names = {name for name, _ in known.archives}
    assert {path.name for path in campaign.folder.completed("excitation")} <= names
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for _, digest in known.archives)


def test_archives_can_be_named_one_by_one(known, campaign, cell):
    paths = [
        path
        for kind in ("excitation", "validation", "standstill")
        for path in campaign.folder.completed(kind)
    ]
    again = known_from(paths, cell, Silent())
    np.testing.assert_array_equal(again.gram, known.gram)
    assert again.archives == known.archives


def test_archives_of_another_robot_are_refused(campaign, cell):
    other = Cell.from_texts(
        cell.text.replace('third = "quadratic"', 'third = "cubic"'), cell.urdf, cell.path
    )
    with pytest.raises(InputError, match="whose robot is not that of"):
        known_from([campaign.folder.root], other, Silent())


def test_a_folder_without_archives_is_refused(tmp_path, cell):
    with pytest.raises(InputError, match="holds no whole archive"):
        known_from([tmp_path], cell, Silent())
    with pytest.raises(InputError, match="is a folder among archives"):
        known_from([tmp_path, tmp_path / "a.mcap"], cell, Silent())


def test_a_second_design_names_what_it_adds_to(campaign, tmp_path, monkeypatch):
    monkeypatch.setattr(design_picture, "draw_design", lambda *_, **__: Figure())
    app = typer.Typer()
    app.command()(design)
    (tmp_path / "my.toml").write_text(
        'method = "b"\n[search]\npopulation = 8\ngenerations = 1\n'
        "[objective]\nmax_relative_std = 50.0\n"
    )
    arguments = [campaign.folder.cell, "--settings", tmp_path / "my.toml", "--kinematic"]
    arguments += ["--earlier", campaign.folder.root, "-o", tmp_path / "out", "--workers", "1"]
    result = CliRunner().invoke(app, list(map(str, arguments)), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    data = tomllib.loads((tmp_path / "out" / "excitation.toml").read_text())
    names = [name for name, _ in data["earlier"]["archives"]]
    assert campaign.folder.completed("excitation")[0].name in names
    judged = data["search"]["parameters"]
    assert 2 <= len(judged) == data["search"]["n_parameters"] < 58
    for path in campaign.folder.completed("excitation"):
        assert open_archive(path).path.name in names
