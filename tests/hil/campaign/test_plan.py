"""The plan of a campaign: found in seconds, or built around a design; and `hil demo` with it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from hil.archive import ArchiveName, open_archive
from hil.base.errors import InputError
from hil.base.progress import Silent
from hil.campaign import Campaign, CampaignPlan, MotionRefusedError, design, plan_around
from hil.campaign.identified_campaign import identify_campaign
from hil.campaign.plan import MIN_POPULATION, quick_settings
from hil.cell import Cell
from hil.cli import app
from hil.cli import demo as demo_module
from hil.control.motion_checks import USABLE_CURRENT_SHARE, MotionChecks
from hil.control.simulator_process import SimulatorProcess
from hil.design import load_design, preset
from hil.design.design import DesignFolder, run_design
from hil.report.output_files import EXPORT_FILES
from hil.results.results import Results
from identification.excitation import Constraints, Criteria, Excitation, sampled
from planner import FourierSeries, PiecewiseCubic
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_cell
from tests.messages import GIVE_A_RAMP

pytestmark = pytest.mark.long


@pytest.mark.parametrize("candidates", [1, 5, 300])
def test_the_quick_search_tries_no_more_than_it_may(cell: Cell, candidates: int) -> None:
    search = quick_settings(cell.with_values({"campaign.candidates": candidates})).search
    assert search.population * search.generations <= max(MIN_POPULATION, candidates)
    assert search.population * search.generations > 0.75 * candidates


def test_the_quick_search_begins_and_ends_at_home(cell: Cell, plan: CampaignPlan) -> None:
    excitation = plan.excitation
    assert excitation.tried <= cell.campaign.candidates
    assert isinstance(excitation.trajectory, PiecewiseCubic)
    ends = excitation.trajectory.sample(np.array([0.0, excitation.trajectory.duration]))[0]
    assert ends == pytest.approx(np.array([cell.home, cell.home]), abs=1e-9)
    checks = MotionChecks.of(cell)
    assert checks.refusal(excitation.trajectory) is None
    assert all(checks.refusal(motion.trajectory) is None for motion in plan.validation)
    assert np.isfinite(excitation.criteria.fitness)


def test_motions_are_planned_within_a_share_of_the_currents(
    tmp_path: Path,
) -> None:
    """Motors are weakened until a plan without that share would reach 90 % of their limits."""
    cell = fast_cell(tmp_path)
    strong = design(cell, Silent())
    worst = max(_largest_shares(cell, strong))
    limits = [float(limit * worst / 0.9) for limit in cell.drive_train.current_limit]
    weak = cell.with_values({"drive_train.current_limit": limits})
    excitation = design(weak, Silent())
    assert max(_largest_shares(weak, excitation)) <= USABLE_CURRENT_SHARE
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


def test_a_plan_states_the_criteria_of_its_motion_alone(quick: Cell, plan: CampaignPlan) -> None:
    """Whatever a design was judged by: some parameters, or what it adds to earlier archives."""
    foreign = replace(plan.excitation.criteria, log10_det=1.0, coupling_index=1.0)
    again = plan_around(quick, replace(plan.excitation, criteria=foreign))
    assert again.excitation.criteria == plan.excitation.criteria


def test_a_design_that_cannot_be_read_is_named_first(tmp_path: Path) -> None:
    arguments = [
        "demo",
        "--output",
        str(tmp_path / "demo"),
        "--excitation",
        str(CELL_PATH),
        "--quiet",
    ]
    result = CliRunner().invoke(app, arguments)
    assert isinstance(result.exception, InputError)
    assert "cell.toml" in str(result.exception)
    assert not (tmp_path / "demo").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "changes"), [("a", {"sines": {"length": 8.0, "ramp": 2.0}}), ("b", {})]
)
def test_the_demo_runs_a_design_and_identifies_from_its_archives(
    tmp_path: Path, method: str, changes: dict[str, Any]
) -> None:
    folder = tmp_path / "demo"
    made = tmp_path / "design"
    small = {"population": 12, "generations": 2}
    settings = preset(method).replaced(search=small, **changes)
    run_design(DesignFolder(made), Cell.load(CELL_PATH), settings, Silent())
    arguments = ["demo", "--output", str(folder), "--excitation", str(made / "excitation.toml")]
    arguments += ["--repetitions", "2", "--validation", "1", "--quiet"]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code in (0, 5), result.output  # a poor motion may not make a good model
    wanted = load_design(made)
    paths = Campaign.open(folder).folder.completed("excitation")
    assert len(paths) == 2
    for path in paths:
        stored = json.loads(open_archive(path).attachments["plan.json"])["excitation"]
        assert stored["trajectory"] == wanted.trajectory.to_dict()
        assert stored["method"] == method
    excitation = Results.load(folder / "results.json").excitation
    assert (excitation.method, excitation.n_sines, excitation.n_via) == (
        (method, 3, None) if method == "a" else (method, None, 6)
    )


Run = Callable[..., Campaign]

UNKNOWN = Criteria(log10_det=0.0, coupling_index=0.0, fitness=0.0, n_samples=1)


def sines(cell: Cell, *, length: float = 8.0, ramp: float = 2.0) -> FourierSeries:
    """Three sines a joint about the middle of its range; the arm stands elsewhere at home."""
    random = np.random.default_rng(12)
    limits = cell.joint_limits
    widest = np.array([0.9, 0.4, 0.5, 0.9, 0.5, 0.9])
    return FourierSeries(
        offset=0.5 * (limits.lower + limits.upper),
        amplitude=random.uniform(-1.0, 1.0, (6, 3)) * widest[:, None],
        frequency=random.uniform(0.8, 3.2, (6, 3)),
        length=length,
        ramp=ramp,
    )


def designed(trajectory: FourierSeries) -> Excitation:
    return Excitation(trajectory, UNKNOWN, method="a", seed=7, tried=1, rejected={})


@pytest.fixture(scope="module")
def quick(cell: Cell) -> Cell:
    return cell.with_campaign(repetitions=2, validation_runs=1)


@pytest.fixture(scope="module")
def swinging(quick: Cell) -> CampaignPlan:
    return plan_around(quick, designed(sines(quick)))


@pytest.fixture(scope="module")
def finished(
    tmp_path_factory: pytest.TempPathFactory, quick: Cell, swinging: CampaignPlan, run: Run
) -> Campaign:
    return run(tmp_path_factory.mktemp("sines") / "campaign", quick, swinging)


def test_the_arm_moves_to_the_start_of_the_sines_and_home(finished: Campaign) -> None:
    names = [ArchiveName.parse(entry.name) for entry in finished.folder.manifest()]
    done = [(name.kind, name.index) for name in names if name is not None]
    assert done == [
        ("move", 0), ("standstill", 0), ("move", 1), ("excitation", 0), ("excitation", 1),
        ("move", 2), ("validation", 0), ("move", 3),
    ]  # fmt: skip
    there, back = (
        open_archive(finished.folder.archives / f"move_00{k}_a1.mcap").columns["target_position"]
        for k in (1, 2)
    )
    middle = finished.plan.excitation.trajectory.sample(np.zeros(1))[0][0]
    assert there[0] == pytest.approx(finished.cell.home, abs=2e-6)
    assert there[-1] == pytest.approx(middle, abs=2e-6)
    assert back[-1] == pytest.approx(finished.cell.home, abs=2e-6)
    for path in finished.folder.completed("excitation"):
        stored = json.loads(open_archive(path).attachments["plan.json"])
        assert set(stored) == {"excitation"}, "the series itself"
        again = Excitation.from_dict(stored["excitation"])
        assert again.trajectory.to_dict() == finished.plan.excitation.trajectory.to_dict()


@pytest.mark.slow
def test_the_model_of_a_swinging_arm_predicts_unseen_motion(finished: Campaign) -> None:
    identification = identify_campaign(finished.folder.root, Silent())
    assert identification.verdict.good, identification.verdict.line
    coverage = identification.results.coverage
    assert coverage is not None and coverage.within_3 >= 55


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"ramp": 0.0}, GIVE_A_RAMP),
        ({"length": 1e300}, "lasts 1e\\+300 s; at most 600 s"),
        ({"length": 1e6}, "lasts 1e\\+06 s; at most 600 s"),
        ({"amplitude": np.full((6, 3), 1e308)}, "velocity of joint 0 is not finite"),
        ({"frequency": np.full((6, 3), 1e300)}, "acceleration of joint 0 is not finite"),
        ({"ramp": 1e-200}, "acceleration of joint 0 is not finite"),
        ({"amplitude": np.ones((6, 99)), "frequency": np.ones((6, 99))}, "99 sines"),
        (
            {name: np.zeros(shape) for name, shape in
             (("offset", 5), ("amplitude", (5, 1)), ("frequency", (5, 1)))},
            "for 5 joints, the arm has 6",
        ),
    ],
    ids=["without ramp", "endless", "long", "wide", "fast", "abrupt", "many sines", "five joints"],
)  # fmt: skip
def test_motions_out_of_bounds_are_refused(
    quick: Cell, changes: dict[str, Any], reason: str
) -> None:
    bad = designed(replace(sines(quick), **changes))
    with pytest.raises(MotionRefusedError, match=reason):
        plan_around(quick, bad)


@pytest.mark.parametrize("ramp", [1e-9, 1e-4, 3e-3, 0.1])
@pytest.mark.parametrize("size", [1e-9, 0.01])
def test_short_ramps_are_checked_within_seconds(quick: Cell, ramp: float, size: float) -> None:
    series = FourierSeries(
        quick.home, np.full((6, 1), size), np.full((6, 1), np.pi), length=5.0, ramp=ramp
    )
    checks = MotionChecks.of(quick)
    constraints = Constraints(quick.joint_limits, checker=checks.checker)
    began = time.process_time()
    checks.refusal(series)
    constraints.violations(series, sampled(series))
    assert time.process_time() - began < 2.0


def test_a_simulated_controller_that_fails_gives_its_reason() -> None:
    simulator = SimulatorProcess.start(CELL_PATH, "--udp", "127.0.0.1:1", "--fault", "rain@10")
    try:
        assert simulator.process.wait(60) == 2
        assert "is not a fault" in (simulator.failure() or "")
        simulator.finish()  # nothing is left to be asked
    finally:
        simulator.end()


def test_an_earlier_campaign_is_not_removed_for_a_bad_motion(
    tmp_path: Path, cell: Cell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever an earlier one left, with the files that identification writes for other tools."""
    wild = FourierSeries(cell.home, np.full((6, 1), 2.0), np.full((6, 1), 3.0), 5.0, 1.0)
    for name in ("manifest.json", "results.json", "report.html", *EXPORT_FILES):
        (tmp_path / name).write_text("{}")
    monkeypatch.setattr(demo_module, "load_design", lambda *_: designed(wild))
    with pytest.raises(MotionRefusedError, match=r"the excitation .*design another motion\."):
        demo_module.demo(output=tmp_path, excitation=tmp_path / "x.toml", force=True, quiet=True)
    assert (tmp_path / "manifest.json").read_text() == "{}"
