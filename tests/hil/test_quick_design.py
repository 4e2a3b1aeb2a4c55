"""The plan of a campaign: found in seconds, or built around a design."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hil.archive import open_archive
from hil.campaign import Campaign, CampaignPlan, design, plan_around
from hil.campaign.plan import LEAST, quick_settings
from hil.cell import Cell
from hil.design import load_design, preset
from hil.design.run import DesignFolder, run_design
from hil.errors import HilError
from hil.motion_checks import PLANNED_CURRENT, MotionChecks
from hil.progress import Silent
from identification.excitation import sampled
from planner import FourierSeries, PiecewiseCubic
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_cell


@pytest.fixture(scope="module")
def tiny(cell: Cell) -> Cell:
    return cell.with_campaign(validation_runs=1)


@pytest.mark.parametrize("candidates", [1, 4, 5, 20, 60, 300, 1000])
def test_the_quick_search_tries_no_more_than_it_may(cell: Cell, candidates: int) -> None:
    text = cell.text.replace("candidates = 20", f"candidates = {candidates}")
    search = quick_settings(Cell.from_texts(text, cell.urdf, cell.path)).search
    assert search.population * search.generations <= max(LEAST, candidates)
    assert search.population * search.generations > 0.75 * candidates


def test_the_quick_search_keeps_the_cell_and_begins_and_ends_at_home(
    cell: Cell, plan: CampaignPlan
) -> None:
    excitation = plan.excitation
    assert excitation.tried <= cell.campaign.candidates
    assert isinstance(excitation.trajectory, PiecewiseCubic)
    ends = excitation.trajectory.sample(np.array([0.0, excitation.trajectory.duration]))[0]
    assert ends == pytest.approx(np.array([cell.home, cell.home]), abs=1e-9)
    checks = MotionChecks.of(cell)
    assert checks.refusal(excitation.trajectory) is None
    assert all(checks.refusal(motion.trajectory) is None for motion in plan.validation)
    assert np.isfinite(excitation.criteria.fitness)


def test_motions_are_planned_with_the_share_of_the_currents_that_a_rehearsal_allows(
    tmp_path: Path,
) -> None:
    """Motors are weakened until a plan that knows no share would be at 90 % of their limits."""
    cell = fast_cell(tmp_path)
    strong = design(cell, Silent())
    worst = max(_largest_shares(cell, strong))
    limits = [float(limit * worst / 0.9) for limit in cell.drive_train.current_limit]
    weak = cell.with_values({"drive_train.current_limit": limits})
    found = design(weak, Silent())
    assert max(_largest_shares(weak, found)) <= PLANNED_CURRENT
    # What was designed elsewhere is judged by the whole limit before it is sent.
    assert MotionChecks.of(weak).refusal(strong.excitation.trajectory) is None


def _largest_shares(cell: Cell, plan: CampaignPlan) -> list[float]:
    """Of the current limits, for each motion of a plan, by the nominal model."""
    currents = MotionChecks.of(cell).currents
    torques = (
        currents.torque(sampled(motion.trajectory))
        for motion in (plan.excitation, *plan.validation)
    )
    return [
        float(np.max(np.abs(currents.current(torque)) / currents.current_limit))
        for torque in torques
    ]


def test_one_seed_is_one_plan_to_the_bit_and_another_is_another(
    tiny: Cell, plan: CampaignPlan
) -> None:
    other = Cell.from_texts(tiny.text.replace("seed = 1", "seed = 2", 1), tiny.urdf, tiny.path)
    assert other.campaign.seed == 2
    once, again, foreign = (
        json.dumps(found.excitation.to_dict())
        for found in (plan, design(tiny, Silent()), design(other, Silent()))
    )
    assert again == once
    assert foreign != once


def test_where_nothing_is_free_the_constraint_is_named(tiny: Cell) -> None:
    text = tiny.text.replace("floor = 0.0", "floor = 1.2")
    raised = Cell.from_texts(text, tiny.urdf, tiny.path)
    with pytest.raises(HilError, match="collision"):
        design(raised, Silent())


def test_a_plan_tells_the_criteria_of_the_motion_by_itself(tiny: Cell, plan: CampaignPlan) -> None:
    """Whatever a design was judged by: some parameters, or what it adds to earlier archives."""
    foreign = replace(plan.excitation.criteria, log10_det=1.0, coupling_index=1.0)
    again = plan_around(tiny, replace(plan.excitation, criteria=foreign))
    assert again.excitation.criteria == plan.excitation.criteria


@pytest.fixture(scope="module")
def designs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Tiny designs for the NS 16 by method A, which begins elsewhere than at home, and by B."""
    folder = tmp_path_factory.mktemp("designs")
    cell = Cell.load(CELL_PATH)
    small = {"population": 12, "generations": 2, "polish": 0}
    for method, changes in (("a", {"sines": {"length": 8.0, "ramp": 2.0}}), ("b", {})):
        settings = preset(method).replaced(search=small, **changes)
        run_design(DesignFolder(folder / method), cell, settings, Silent())
    return {method: folder / method / "excitation.toml" for method in ("a", "b")}


def demo(*arguments: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "hil", "demo", *map(str, arguments), "--quiet"]
    return subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "kind"),
    [
        pytest.param("a", FourierSeries, id="sines", marks=pytest.mark.slow),
        pytest.param("b", PiecewiseCubic, id="via points"),
    ],
)
def test_the_demo_runs_a_design_and_identifies_from_its_archives(
    tmp_path: Path, designs: dict[str, Path], method: str, kind: type
) -> None:
    folder, file = tmp_path / "demo", designs[method]
    done = demo("--output", folder, "--excitation", file, "--repetitions", 2, "--validation", 1)
    assert done.returncode in (0, 5), done.stderr  # a poor motion may not make a good model
    campaign, wanted = Campaign.open(folder), load_design(file)
    assert isinstance(wanted.trajectory, kind)
    archives = [open_archive(path) for path in campaign.folder.completed("excitation")]
    assert len(archives) == 2
    for archive in archives:
        stored = json.loads(archive.attachments["plan.json"])["excitation"]
        assert stored["trajectory"] == wanted.trajectory.to_dict()
        assert stored["method"] == method
    results = json.loads((folder / "results.json").read_text())["excitation"]
    assert results["method"] == method
    assert results["n_sines"] == (3 if method == "a" else None)
    assert results["n_via"] == (None if method == "a" else 6)


def test_a_design_that_cannot_be_read_is_named_before_anything_is_made(tmp_path: Path) -> None:
    folder = tmp_path / "demo"
    done = demo("--output", folder, "--excitation", CELL_PATH)
    assert done.returncode == 2
    assert "cell.toml" in done.stderr and "Traceback" not in done.stderr
    assert not folder.exists()


@pytest.mark.slow
def test_a_campaign_has_one_excitation(tmp_path: Path, designs: dict[str, Path]) -> None:
    done = demo("--output", tmp_path, "--resume", "--excitation", designs["b"])
    assert done.returncode == 2
    assert "has an excitation already" in done.stderr.replace("\n", " ")
    assert not list(tmp_path.iterdir())
