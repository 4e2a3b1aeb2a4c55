"""An excitation of sines (method A): run, archived, identified and compared with its plan."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.archive import ArchiveName, open_archive
from hil.campaign import Campaign, CampaignPlan, MotionRefusedError, plan_around
from hil.cell import Cell
from hil.identify import Identification, identify_campaign
from hil.motion_checks import MotionChecks
from hil.progress import Silent
from hil.report.page import facts
from identification.excitation import Constraints, Criteria, Excitation, sampled
from planner import FourierSeries

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


@pytest.fixture(scope="module")
def found(finished: Campaign) -> Identification:
    return identify_campaign(finished.folder.root, Silent())


def test_the_criteria_of_a_plan_are_those_of_its_motion_over_all_parameters(
    swinging: CampaignPlan,
) -> None:
    criteria = swinging.excitation.criteria
    assert criteria.n_samples == pytest.approx(8000, abs=1)
    assert criteria.condition is not None and criteria.scaled_condition is not None
    assert 0.0 < criteria.coupling_index < 58 * 57 / 2


def test_the_arm_is_taken_to_where_the_sines_begin_and_home_again(finished: Campaign) -> None:
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


def test_the_commanded_motion_is_the_series_to_the_wire(finished: Campaign) -> None:
    archive = open_archive(finished.folder.completed("excitation")[0])
    commanded = archive.columns["commanded_position"]
    commanded = commanded[~np.isnan(commanded).any(axis=1)]
    times = np.arange(len(commanded)) * finished.cell.period
    planned = finished.plan.excitation.trajectory.sample(times)[0]
    assert commanded == pytest.approx(planned, abs=2e-6)


def test_the_archive_carries_the_series_itself(finished: Campaign) -> None:
    for path in finished.folder.completed("excitation"):
        stored = json.loads(open_archive(path).attachments["plan.json"])
        assert set(stored) == {"excitation"}
        again = Excitation.from_dict(stored["excitation"])
        assert again.trajectory.to_dict() == finished.plan.excitation.trajectory.to_dict()


@pytest.mark.slow
def test_the_model_of_a_swinging_arm_predicts_unseen_motion(found: Identification) -> None:
    assert found.verdict.good, found.verdict.line
    coverage = found.results.coverage
    assert coverage is not None and coverage.within_3 >= 55


def test_the_criteria_of_what_was_executed_are_the_planned_ones(found: Identification) -> None:
    """Same instants, all 58 columns. What is left: stiction makes the measured speed change its
    sign elsewhere, and the acceleration at a reversal larger, by some per mille."""
    planned, executed = found.results.excitation.planned, found.results.excitation.executed
    assert planned is not None
    assert executed.n_samples == pytest.approx(2 * planned.n_samples, abs=2)
    assert executed.coupling_index_max == planned.coupling_index_max == 1653.0
    # 58 columns whose lengths differ by a per mille or two on average.
    assert executed.log10_det == pytest.approx(planned.log10_det, abs=58 * np.log10(1.01))
    assert executed.coupling_index == pytest.approx(planned.coupling_index, rel=0.02)
    assert executed.scaled_condition == pytest.approx(planned.scaled_condition, rel=0.02)


def test_the_report_says_which_method_found_which_motion(found: Identification) -> None:
    (motion,) = (text for term, text in facts(found.results) if term == "Excitation")
    assert motion == "8.00 s, 3 sines per joint, designed by the paper's method A"


def test_bare_sines_are_refused_before_anything_moves(
    tmp_path: Path, quick: Cell, swinging: CampaignPlan
) -> None:
    bare = replace(swinging, excitation=designed(sines(quick, ramp=0.0)))
    wrong = "begin and end at full speed; give them a ramp"
    with pytest.raises(MotionRefusedError, match=wrong):
        plan_around(quick, bare.excitation)
    with pytest.raises(MotionRefusedError, match=wrong):
        Campaign.create(tmp_path / "bare", quick, bare)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"length": 1e300}, "lasts 1e\\+300 s; at most 600 s"),
        ({"length": 1e6}, "lasts 1e\\+06 s; at most 600 s"),
        ({"amplitude": np.full((6, 3), 1e308)}, "beyond all numbers"),
        ({"frequency": np.full((6, 3), 1e300)}, "beyond all numbers"),
        ({"ramp": 1e-200}, "beyond all numbers"),
        ({"amplitude": np.ones((6, 99)), "frequency": np.ones((6, 99))}, "99 sines"),
        (
            {name: np.zeros(shape) for name, shape in
             (("offset", 5), ("amplitude", (5, 1)), ("frequency", (5, 1)))},
            "for 5 joints, the arm has 6",
        ),
    ],
    ids=["endless", "long", "wide", "fast", "abrupt", "many sines", "five joints"],
)  # fmt: skip
def test_what_cannot_even_be_looked_at_is_refused_by_name(
    tmp_path: Path, quick: Cell, swinging: CampaignPlan, changes: dict[str, Any], reason: str
) -> None:
    bad = designed(replace(sines(quick), **changes))
    with pytest.raises(MotionRefusedError, match=reason):
        plan_around(quick, bad)
    with pytest.raises(MotionRefusedError, match=f"repetition 1 was not sent: .*{reason}"):
        Campaign.create(tmp_path / "bad", quick, replace(swinging, excitation=bad))


@pytest.mark.parametrize("ramp", [1e-9, 1e-6, 1e-4, 1e-3, 3e-3, 0.02, 0.1])
@pytest.mark.parametrize("size", [1e-9, 1e-5, 0.01])
def test_short_ramps_are_told_in_no_time(quick: Cell, ramp: float, size: float) -> None:
    series = FourierSeries(
        quick.home, np.full((6, 1), size), np.full((6, 1), np.pi), length=5.0, ramp=ramp
    )
    checks = MotionChecks.of(quick)
    constraints = Constraints(quick.joint_limits, checker=checks.checker)
    began = time.process_time()
    checks.refusal(series)
    constraints.violations(series, sampled(series))
    assert time.process_time() - began < 2.0


@pytest.mark.parametrize(
    ("factor", "pace", "broken"),
    [(3.0, 1.0, "position of J"), (1.0, 2.5, "of J")],
)
def test_sines_beyond_a_limit_are_refused(
    quick: Cell, factor: float, pace: float, broken: str
) -> None:
    checks, fine = MotionChecks.of(quick), sines(quick)
    assert checks.refusal(fine) is None
    wild = replace(fine, amplitude=factor * fine.amplitude, frequency=pace * fine.frequency)
    reason = checks.refusal(wild)
    assert reason is not None and broken in reason
