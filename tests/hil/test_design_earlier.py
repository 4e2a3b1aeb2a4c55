"""Sequential design: what earlier archives say joins what the new motion is going to say."""

from __future__ import annotations

import re
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import typer
from matplotlib.figure import Figure
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.campaign import plan_around
from hil.cell import Cell
from hil.cli.design import design
from hil.design import preset, problem_of
from hil.design.earlier import known_from
from hil.design.problem import Knowledge
from hil.errors import InputError
from hil.identify import identify_archives
from hil.identify.options import FIXED
from hil.plots import design_picture
from hil.progress import Silent
from identification.excitation import Criteria, Excitation, midpoints
from planner import FourierSeries


@pytest.fixture(scope="module")
def known(campaign, cell) -> Knowledge:
    return known_from([campaign.folder.root], cell, Silent())


@pytest.mark.slow
def test_joints_count_by_the_noise_of_their_torque(known, campaign):
    kinds = ("excitation", "validation", "standstill")
    paths = [path for kind in kinds for path in campaign.folder.completed(kind)]
    options = replace(FIXED, in_sample=True)
    pooled = identify_archives(paths, Silent(), options).estimate.pooled
    np.testing.assert_allclose(known.joint_weights, 1.0 / pooled.noise_std**2)
    np.testing.assert_array_equal(known.values, pooled.values)
    np.testing.assert_array_equal(known.std, pooled.std)


def test_running_the_same_motion_again_says_about_the_same_again(excitations, cell, plan):
    # The archives hold a sample for each cycle of 1 ms, the search takes one every 8 ms. A fit
    # also leaves out rows near reversals, where a smoothed acceleration says little: up to one in
    # twenty of those in which a joint accelerates.
    known = known_from(excitations, cell, Silent())
    objective = problem_of(cell, preset("b").kinematic(), known).objective
    assert objective.repetitions == len(excitations) == 3
    both = objective.information(midpoints(plan.excitation.trajectory))
    np.testing.assert_allclose(np.diag(known.gram) / np.diag(both), 0.5, atol=0.03)


@pytest.fixture(scope="module")
def excitations(campaign) -> list[Path]:
    return campaign.folder.completed("excitation")


def rows(found: Knowledge) -> np.ndarray:
    """Squares of each joint's friction columns; they depend on no weight."""
    of_friction = [k for k, name in enumerate(found.names) if name.startswith("f")]
    joints = [int(found.names[k].rpartition("_")[2]) - 1 for k in of_friction]
    return np.diag(found.gram)[of_friction] / found.joint_weights[joints]


@pytest.mark.slow
def test_every_motion_counts_whether_fitted_or_held_out(known, excitations, campaign, cell):
    """Of three repetitions alone one is held out, of one the end; a campaign has other motions."""
    three = known_from(excitations, cell, Silent())
    one = known_from(excitations[:1], cell, Silent())
    assert one.samples == pytest.approx(three.samples / 3.0, rel=0.01)
    np.testing.assert_allclose(rows(one), rows(three) / 3.0, rtol=0.02)
    assert [name for name, _ in one.archives] == [excitations[0].name]
    validation = campaign.folder.completed("validation")
    assert {name for name, _ in known.archives} == {p.name for p in [*excitations, *validation]}
    whole = known_from([*excitations, *validation[:1]], cell, Silent())
    assert np.all(rows(whole) > 1.05 * rows(three))
    assert np.all(rows(known) > 1.05 * rows(whole))


class Listening(Silent):
    def __init__(self) -> None:
        self.said: list[str] = []

    def say(self, text: str) -> None:
        self.said.append(text)


@pytest.mark.slow
def test_a_joint_that_stood_is_weighted_like_the_others_and_named(tmp_path, cell, run):
    short = cell.with_campaign(repetitions=1, validation_runs=1)
    limits, random = cell.joint_limits, np.random.default_rng(12)
    amplitude = random.uniform(-0.5, 0.5, (6, 3))
    amplitude[5] *= 1e-3  # its peak speed stays below what counts as standstill
    series = FourierSeries(
        offset=0.5 * (limits.lower + limits.upper),
        amplitude=amplitude,
        frequency=random.uniform(0.8, 3.2, (6, 3)),
        length=8.0,
        ramp=2.0,
    )
    unknown = Criteria(log10_det=0.0, coupling_index=0.0, fitness=0.0, n_samples=1)
    excitation = Excitation(series, unknown, method="a", seed=7, tried=1, rejected={})
    folder = run(tmp_path / "campaign", short, plan_around(short, excitation)).folder
    reporter = Listening()
    known = known_from(folder.completed("excitation"), cell, reporter)
    (warning,) = (text for text in reporter.said if text.startswith("warning: "))
    assert f"{cell.joint_names[5]} never moved" in warning
    assert not any(name in warning for name in cell.joint_names[:5])
    drives = cell.drive_train
    strength = np.abs(drives.motor_from_joint.T) @ (drives.torque_constant * drives.current_limit)
    share = known.joint_weights**-0.5 / strength
    assert share[5] == pytest.approx(np.median(share[:5]))
    # A design with it asks for what is missing: the sixth joint's parameters.
    assert np.isinf(known.std[known.names.index("f0_6")])
    assert known.gram[known.names.index("f0_6")].tolist() == [0.0] * len(known.names)
    problem = problem_of(cell, preset("b").kinematic(), known)
    genes = problem.genome.sample(np.random.default_rng(1), 3)
    assert np.all(np.isfinite(problem.score(genes).measures))


def test_archives_can_be_named_one_by_one(known, campaign, cell):
    kinds = ("excitation", "validation", "standstill")
    paths = [path for kind in kinds for path in campaign.folder.completed(kind)]
    again = known_from(paths, cell, Silent())
    np.testing.assert_array_equal(again.gram, known.gram)
    assert again.archives == known.archives
    assert all(re.fullmatch("[0-9a-f]{64}", digest) for _, digest in known.archives)


def test_archives_of_another_robot_are_refused(campaign, cell):
    text = cell.text.replace('third = "quadratic"', 'third = "cubic"')
    other = Cell.from_texts(text, cell.urdf, cell.path)
    with pytest.raises(InputError, match="whose robot is not that of"):
        known_from([campaign.folder.root], other, Silent())


def test_a_folder_without_archives_is_refused(tmp_path, cell):
    with pytest.raises(InputError, match="holds no whole archive"):
        known_from([tmp_path], cell, Silent())
    with pytest.raises(InputError, match="is a folder among archives"):
        known_from([tmp_path, tmp_path / "a.mcap"], cell, Silent())


@pytest.mark.slow
def test_a_second_design_names_what_it_adds_to(campaign, tmp_path, monkeypatch):
    drawn = {}

    def draw(*_, **asked):
        drawn.update(asked)
        return Figure()

    monkeypatch.setattr(design_picture, "draw_design", draw)
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
    assert drawn["together"]
    data = tomllib.loads((tmp_path / "out" / "excitation.toml").read_text())
    names = [name for name, _ in data["earlier"]["archives"]]
    assert campaign.folder.completed("excitation")[0].name in names
    judged = data["search"]["parameters"]
    assert 2 <= len(judged) == data["search"]["n_parameters"] < 58
    for path in campaign.folder.completed("excitation"):
        assert open_archive(path).path.name in names
