"""What changed between campaigns: trends of arms, and campaigns compared, page and statistics."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.stats import kendalltau
from typer.testing import CliRunner

from hil.batch.types import Arm, BatchResult, LevelEstimate, Unused
from hil.batch.workers import LocalWorkers
from hil.campaign import Campaign, CampaignPlan
from hil.campaign.plan import design
from hil.cell import Cell
from hil.cli import app
from hil.compare import Comparison, compare_campaigns, gather, payload
from hil.compare.comparison import CampaignSet, against_first, effective_count, figure, holm
from hil.compare.trend import (
    FALSE_ALARMS,
    MIN_CAMPAIGNS,
    ArmTrend,
    Axis,
    arm_trend,
    chart,
    drift,
    findings,
    friction_in,
    friction_weights,
    limits,
    qn_scale,
    shifts,
    summary,
)
from hil.errors import InputError
from hil.identify import identify_campaign
from hil.progress import Silent
from hil.report.changes import comparison_page, trend_page
from identification.model.payload import Payload

from . import arm_histories
from .arm_histories import FRICTION, Condition, Load, history, model, steady, trend_of
from .fast_cell import fast_cell
from .test_report import HOSTILE, Page, assert_inert, assert_stands_alone

# --- the chart ---------------------------------------------------------------------------------


def next_limits(earlier: np.ndarray, share: float = 0.01) -> np.ndarray:
    """Centre, low and high of one more value after a history of one level."""
    places = list(range(len(earlier)))
    return np.array(limits(earlier, np.zeros(len(earlier)), share, [places], 0, 0.0))


@pytest.mark.parametrize("count", [5, 6, 8, 12, 25])
@pytest.mark.parametrize("share", [0.01, 0.001])
def test_unchanged_values_depart_no_more_often_than_the_share(count: int, share: float) -> None:
    random = np.random.default_rng(count)
    runs = 40_000 if count < 20 else 10_000
    first, second = np.triu_indices(count, 1)
    values = random.standard_normal((runs, count))
    half = count // 2 + 1
    # Qn of many histories at once, against `qn_scale` of some of them.
    distance = np.sort(np.abs(values[:, first] - values[:, second]), axis=1)
    raw = distance[:, half * (half - 1) // 2 - 1]
    factor = qn_scale(values[0]) / raw[0]
    assert qn_scale(values[1]) == pytest.approx(factor * raw[1])
    centre, _, high = next_limits(values[0], share)
    reach = (high - centre) / qn_scale(values[0])
    new = random.standard_normal(runs)
    outside = np.mean(np.abs(new - np.median(values, axis=1)) > reach * factor * raw)
    allowed = 3.0 * math.sqrt(share / runs)
    assert outside <= share + allowed
    assert outside >= 0.1 * share - allowed


SCATTER = [1.0, 1.1, 0.9, 1.05, 0.95, 1.02, 1.0]


@pytest.mark.parametrize(
    ("values", "std", "departing"),
    [
        ([1.0] * MIN_CAMPAIGNS + [99.0], 0.0, [MIN_CAMPAIGNS]),
        ([1.0] * (MIN_CAMPAIGNS - 1) + [99.0], 0.0, []),  # too short a history
        ([1.0] * 8 + [1.5], 0.0, [8]),
        ([1.0] * 8 + [1.5], 0.5, []),  # no narrower than its values are known
        ([*SCATTER, 3.0, 3.0, 3.0, 3.0], 0.0, [7, 8, 9, 10]),  # what departed is no history
        ([1.0, 1.1, 0.9, math.nan, 1.0, 1.05, math.nan, 5.0], 0.0, [7]),
    ],
)
def test_departures(values: list[float], std: float, departing: list[int]) -> None:
    found = chart(np.array(values), np.full(len(values), std), 0.01)
    assert np.flatnonzero(found.departs).tolist() == departing


def test_values_that_remain_form_a_new_level() -> None:
    there = [3.0 * one for one in SCATTER]
    found = chart(np.array([*SCATTER, *there, 4.9]), np.zeros(15), 0.01)
    assert found.departs == (False,) * 7 + (True,) * MIN_CAMPAIGNS + (False,) * 2 + (True,)
    assert found.levels == (0,) * 7 + (1,) * 7 + (-1,)
    assert found.limits[-1, 0] == pytest.approx(3.0)


@pytest.mark.parametrize("stay", [1, 3, MIN_CAMPAIGNS, 9])
@pytest.mark.parametrize("rise_only", [False, True])
def test_a_value_that_returns_has_changed_twice(stay: int, rise_only: bool) -> None:
    damaged = (3.0 * np.array(SCATTER * 2)[:stay]).tolist()
    values = np.array([*SCATTER, *damaged, *SCATTER])
    found = shifts(chart(values, np.zeros(len(values)), 0.01, rise_only=rise_only))
    places = [(one.returns, one.first, one.last) for one in found]
    assert places == [(False, 7, 6 + stay), (True, 7 + stay, 13 + stay)]


def test_values_on_both_sides_form_no_level() -> None:
    found = chart(np.array([*SCATTER, *[3.0, -1.0] * 6]), np.zeros(19), 0.01)
    assert set(found.levels) == {0, -1}
    assert all(found.departs[7:])


@pytest.mark.slow
def test_after_a_change_of_level_as_few_depart() -> None:
    runs, share = 2000, 0.01
    values = np.random.default_rng(11).standard_normal((runs, 9 + MIN_CAMPAIGNS))
    values[:, 8:] += 1000.0
    departing = sum(chart(one, np.zeros(len(one)), share).departs[-1] for one in values)
    assert departing / runs <= share + 3.0 * math.sqrt(share / runs)


def test_a_drift_is_a_rank_correlation_and_a_median_slope() -> None:
    time = np.array([0.0, 1.0, 2.0, 4.0, 7.0, 11.0])
    values = 2.0 + 0.5 * time + np.array([0.1, -0.1, 0.0, 0.2, -0.2, 0.0])
    found = drift(time, values)
    pairs = [(i, j) for i in range(6) for j in range(i)]
    slopes = [(values[i] - values[j]) / (time[i] - time[j]) for i, j in pairs]
    assert found.slope == pytest.approx(np.median(slopes))
    assert found.low <= 0.5 <= found.high
    assert found.p_value == pytest.approx(kendalltau(time, values).pvalue)


# --- what is watched ---------------------------------------------------------------------------


def test_friction_of_an_axis_is_the_mean_of_both_directions() -> None:
    arm, one = model(), history(steady, 1, seed=1)[0]
    speed = np.array([0.5, 0.6, 0.7, 0.8, 0.9, 1.0])
    axes = [Axis(name, "N·m", at, "rad/s") for name, at in zip(arm.joint_names, speed, strict=True)]
    values = np.random.default_rng(1).uniform(0.1, 2.0, arm.n_parameters)
    values[: arm.base.rank] = 0.0
    still = np.zeros((1, 6))
    forwards, backwards = (
        arm.torque(values, still, sign * speed[None], still)[0] for sign in (1.0, -1.0)
    )
    variances = np.ones(arm.n_parameters)
    variances[arm.parameter_names.index("f1_2")] = np.inf  # then that of the axis is not known
    level = replace(one, values=values, covariance=np.diag(variances))
    found, std = friction_in(level, friction_weights(arm, axes))
    expected = 0.5 * (forwards - backwards)
    expected[1] = np.nan
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert std[5] == pytest.approx(math.sqrt(3.0))


# --- histories ---------------------------------------------------------------------------------


@cache
def quiet() -> ArmTrend:
    return trend_of(steady, 12, seed=21)


def troubled(k: int, random: np.random.Generator) -> Condition:
    """Axis 2 wears, axis 3 is damaged at last, axis 5 is noisy once; a gripper from the eighth."""
    now = steady(k, random)
    friction, louder = now.friction.copy(), np.ones(6)
    friction[:, 1] *= 1.0 + 0.05 * k
    friction[:, 2] *= 1.4 if k >= 10 else 1.0
    louder[4] = 1.8 if k == 11 else 1.0
    return Condition(friction, Load(3.0 if k >= 7 else 0.0), louder)


@cache
def changed() -> ArmTrend:
    return trend_of(troubled, 12)


def test_an_arm_without_changes_has_none() -> None:
    arm = quiet()
    assert [one.level for one in findings(arm)] == ["quiet"]
    assert summary(arm) == "0 changes, 0 earlier, in 12 campaigns"


def test_wear_and_damage_are_those_of_their_axis_alone() -> None:
    arm = changed()
    assert [axis.joint for axis in arm.axes if axis.drifts] == ["joint_2"]
    slope = arm.axes[1].drift
    speed = np.array([1.0, arm.axes[1].speed, arm.axes[1].speed ** 2])
    truth = 0.05 * 11 * float(FRICTION[:, 1] @ speed) / arm.time[-1]
    assert slope.low <= truth <= slope.high
    which = {a.joint: np.flatnonzero(a.friction.departs).tolist() for a in changed().axes}
    assert which == {name: [] for name in which} | {"joint_3": [10, 11]}


def test_only_a_larger_torque_error_is_a_departure() -> None:
    arm = changed()
    departing = {axis.joint: np.flatnonzero(axis.error.departs).tolist() for axis in arm.axes}
    assert departing["joint_5"] == [11]
    campaigns = history(steady, 7, seed=5)
    quieter = replace(campaigns[-1], noise_std=0.3 * campaigns[-1].noise_std)
    better = arm_trend("arm", model(), [*campaigns[:-1], quieter])
    assert not any(axis.error.departs[-1] for axis in better.axes)


def test_an_added_payload_is_estimated() -> None:
    payload = changed().payload
    assert np.flatnonzero(payload.changed).tolist() == [7]
    assert not any(payload.other)
    change = payload.changes[7]
    assert abs(change.mass - 3.0) < 3.0 * change.mass_std < 0.5
    np.testing.assert_array_less(
        np.abs(change.moment - 3.0 * np.array(Load().centre)), 4.0 * change.moment_std
    )
    assert np.abs(payload.mass[:7]).max() < 0.4
    np.testing.assert_allclose(payload.mass[7:], 3.0, atol=0.4)


def test_half_a_kilogram_less_is_found_between_two_campaigns() -> None:
    arm = trend_of(lambda k, random: replace(steady(k, random), load=Load(1.0 - 0.5 * k)), 2)
    assert arm.payload.changed == (False, True)
    change = arm.payload.changes[1]
    assert abs(change.mass + 0.5) < 4.0 * change.mass_std
    assert re.search(r"changed between .*: -0\.\d+ ± .* kg", findings(arm)[0].words)


def test_inertia_of_another_link_is_no_payload() -> None:
    arm = model()
    before, after = history(steady, 2, seed=2)
    # The second link gets heavier: a cable guide, not a tool.
    standard = np.zeros(len(arm.layout.names))
    standard[arm.layout.names.index("mc2x")] = 8.0
    moved = after.values.copy()
    moved[: arm.base.rank] += arm.base.grouping @ standard
    found = arm_trend("arm", arm, [before, replace(after, values=moved)])
    assert found.payload.changed == (False, False)
    assert found.payload.other == (False, True)
    assert "of which a payload explains only" in findings(found)[0].words


def test_the_joint_test_rarely_reports_unchanged_arms() -> None:
    """Parameters drawn from their own covariance: T² must be F distributed, or smaller."""
    one = history(steady, 1, seed=1)[0]
    onto = payload.projection(
        model(), np.isfinite(one.std), one.information, int(one.samples.sum())
    )
    assert onto is not None
    assert one.covariance is not None
    random = np.random.default_rng(8)
    blocks = 40
    root = np.linalg.cholesky(one.covariance + 1e-12 * np.diag(np.diag(one.covariance)))
    p_values = []
    for _ in range(1500):
        states = []
        for _ in range(2):
            # Each campaign estimates its covariance from as many blocks.
            scores = random.standard_normal((blocks, len(root))) @ root.T
            values = root @ random.standard_normal(len(root))
            covariance = scores.T @ scores / blocks
            states.append(payload.state(onto, values, covariance, blocks))
        change = payload.compare(onto, *states)
        p_values.append(change.p_value)
    assert np.mean(np.array(p_values) < 0.01) <= 0.01 + 3.0 * math.sqrt(0.01 / 1500)
    assert np.mean(np.array(p_values) < 0.5) > 0.3


def test_campaigns_that_scatter_much_raise_no_alarm() -> None:
    """A hose that pulls differently every time: the arm's own changes are the measure."""
    arm = model()
    campaigns = history(steady, 9, seed=3)
    assert campaigns[0].covariance is not None
    random = np.random.default_rng(4)
    restless = [
        replace(one, values=one.values + 5.0 * one.std * random.standard_normal(len(one.std)))
        for one in campaigns
    ]
    assert not any(arm_trend("arm", arm, restless).payload.changed)


def repaired(k: int, random: np.random.Generator) -> Condition:
    """Axis 3 rubs in campaigns 7 to 9, until it is greased."""
    now = steady(k, random)
    friction = now.friction.copy()
    friction[:, 2] *= 1.4 if 7 <= k <= 9 else 1.0
    return replace(now, friction=friction)


def test_an_axis_that_is_repaired_has_changed_twice() -> None:
    arm = trend_of(repaired, 12)
    words = [one.words for one in findings(arm)]
    assert {one.level for one in findings(arm)} == {"past"}
    assert len(words) == 2
    assert re.search(r"joint_3 departs .*, from c07 \(2026-04-15\) to c09", words[0])
    assert re.search(r"joint_3 has returned .*, since c10", words[1])
    assert summary(arm) == "0 changes, 2 earlier, in 12 campaigns"


SPOOL = Load(3.0)
RIGHT = Payload(3.0, SPOOL.centre, inertia=(0.03, 0.0, 0.0, 0.03, 0.0, 0.03))
WRONG = Payload(6.0, SPOOL.centre, inertia=(0.06, 0.0, 0.0, 0.06, 0.0, 0.06))


@pytest.mark.parametrize(
    ("carried", "stated", "payload", "verdict", "changed", "mass"),
    [
        (2, 2, RIGHT, "torques agree", [], [0.0, 0.0, 3.0, 3.0]),
        (0, 2, RIGHT, "carried before as well", [], [0.0, 0.0, 0.0, 0.0]),
        (1, 2, RIGHT, "carried before as well", [1], [0.0, 3.0, 3.0, 3.0]),
        (2, 2, WRONG, "torques disagree", [2], [0.0, 0.0, 3.0, 3.0]),
    ],
)
def test_a_stated_payload_is_compared_with_the_torques(
    carried: int, stated: int, payload: Payload, verdict: str, changed: list[int], mass: list[float]
) -> None:
    """A load carried and a payload stated from these campaigns on, of four."""

    def life(k: int, random: np.random.Generator) -> Condition:
        load = SPOOL if k >= carried else Load()
        return replace(steady(k, random), load=load, stated=payload if k >= stated else None)

    arm = trend_of(life, 4)
    assert np.flatnonzero(arm.payload.changed).tolist() == changed
    assert not any(arm.payload.other)
    verdicts = [one and one.verdict for one in arm.payload.statements]
    assert verdicts == [None, None, verdict, None]
    np.testing.assert_allclose(arm.payload.mass, mass, atol=0.3)
    texts = {one.level for one in findings(arm) if verdict in one.words}
    assert texts == ({"past"} if verdict == "torques disagree" else {"quiet"})


def test_campaigns_are_in_order_of_their_times_or_names() -> None:
    names = ("c10", "c9", "c1")
    campaigns = [
        replace(one, when="", campaign=f"line/{name}")
        for one, name in zip(history(steady, 3, seed=2), names, strict=True)
    ]
    arm = arm_trend("arm", model(), campaigns)
    assert not arm.dated
    assert arm.time.tolist() == [1.0, 2.0, 3.0]
    assert arm.names == ("c1", "c9", "c10")
    assert "the order is that of their folders' names, from c1 to c10" in findings(arm)[-1].words
    campaigns = history(steady, 4, seed=2)
    campaigns[1] = replace(campaigns[1], when="")
    arm = arm_trend("arm", model(), campaigns[::-1])
    assert arm.dated
    assert [name[:3] for name in arm.names] == ["c00", "c02", "c03"]  # in order of time
    assert arm.time[:2].tolist() == [0.0, 31.0]
    assert arm.undated == ("line/c01",)
    assert "Without recording time, not part of the trend: line/c01" in findings(arm)[-1].words


def test_axes_without_information_are_left_out() -> None:
    campaigns = []
    for one in history(steady, 2, seed=2):
        std, noise = one.std.copy(), one.noise_std.copy()
        std[[name in ("f0_1", "mc2x") for name in one.names]] = np.inf
        noise[0] = np.nan
        covariance = np.asarray(one.covariance).copy()
        np.fill_diagonal(covariance, std**2)
        campaigns.append(
            replace(one, std=std, noise_std=noise, covariance=covariance, speed_rms=None)
        )
    arm = arm_trend("arm", model(), [*campaigns, *campaigns * 3])
    assert np.isnan(arm.axes[0].friction.values).all()
    assert not any(any(axis.friction.departs) for axis in arm.axes)
    text = trend_page(batch_result(), [arm]).decode()
    assert text.count('<span class="title">joint_1</span>') == 0
    assert text.count('<span class="title">joint_2</span>') == 2


# --- the page ----------------------------------------------------------------------------------

BROKEN = Unused("/data/<b>cut</b>.mcap", "its footer is missing")


def batch_result(*broken: Unused) -> BatchResult:
    return BatchResult("wls", {}, (), (), (), broken, (), read=1, cached=0, code="")


@cache
def page() -> str:
    return trend_page(batch_result(BROKEN), [changed(), quiet()]).decode()


def test_the_page_begins_with_the_findings() -> None:
    head = page().split("<main>")[0]
    for one in findings(changed()):
        assert one.words.replace("'", "&#39;") in head
    assert head.index("joint_3 departs") < head.index("The payload has changed")
    assert "Earlier: The payload" in head
    assert_stands_alone(page())
    assert page().count("<svg") >= 2 * 12
    assert all(name in page() for name in model().parameter_names)
    assert "its footer is missing" in page()
    assert "&lt;b&gt;cut" in page() and "<b>cut" not in page()


@pytest.mark.slow
def test_false_alarms_are_rare() -> None:
    """Any rule, over whole histories: at most the stated share of campaigns."""
    alarms = campaigns = drifts = 0
    for seed in range(60):
        arm = trend_of(steady, 12, seed=1000 + seed)
        for k in range(1, 12):
            axes = any(axis.friction.departs[k] or axis.error.departs[k] for axis in arm.axes)
            alarms += axes or arm.payload.changed[k] or arm.payload.other[k]
            campaigns += 1
        drifts += any(axis.drifts for axis in arm.axes)
    assert alarms <= FALSE_ALARMS * campaigns + 3.0 * math.sqrt(FALSE_ALARMS * campaigns)
    assert drifts <= 60 * FALSE_ALARMS + 3.0 * math.sqrt(60 * FALSE_ALARMS)


# Campaigns compared: planted changes are found, and nothing else


Array = NDArray[np.float64]

PLANTED = 1.3
"""Factor on the shoulder's friction in the second campaign."""
SIMULATED = "coulomb = [6.0, 3.0]\nviscous = [3.0, 1.5]\nthird"


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Two campaigns of one arm, the second with more friction, and one of another arm."""
    root = tmp_path_factory.mktemp("compared")
    usual = fast_cell(root, repetitions=3)
    plan = design(usual, Silent())
    changed = f"coulomb = [{6.0 * PLANTED}, 3.0]\nviscous = [{3.0 * PLANTED}, 1.5]\nthird"
    stiff = usual.text.replace(SIMULATED, changed).replace("seed = 3", "seed = 4")
    other = usual.text.replace("gear_ratio = [100.0", "gear_ratio = [110.0")
    assert stiff != usual.text != other
    return {
        name: ran(root / name, Cell.from_texts(text, usual.urdf, usual.path), plan)
        for name, text in (("march", usual.text), ("june", stiff), ("other", other))
    }


def ran(folder: Path, cell: Cell, plan: CampaignPlan) -> Path:
    Campaign.create(folder, cell, plan).run(unrehearsed=True, durable=False)
    return folder


def compared(*places: Path) -> Comparison:
    with LocalWorkers(1) as workers:
        return compare_campaigns(gather([str(p) for p in places], workers, Silent()))


@pytest.fixture(scope="module")
def comparison(folders: dict[str, Path]) -> Comparison:
    return compared(folders["march"], folders["june"])


def test_changed_friction_is_found_on_its_axis_only(comparison: Comparison) -> None:
    friction = comparison.friction
    assert friction.changed.tolist() == [[False, True], [False, False]]
    change, low, high = friction.shares[0, 1]
    assert low < PLANTED - 1.0 < high and change == pytest.approx(PLANTED - 1.0, abs=0.02)
    assert comparison.verdict == "Changed: friction of shoulder"
    assert re.search("shoulder.* 29.9 % higher in june than in march", comparison.findings[0].words)


def test_the_first_campaign_is_the_reference(
    folders: dict[str, Path], comparison: Comparison
) -> None:
    back = compared(folders["june"] / "results.json", folders["march"])
    assert back.names == ("june", "march")
    assert back.friction.shares[0, 1, 0] == pytest.approx(1.0 / PLANTED - 1.0, abs=0.02)
    found = comparison.prediction
    assert found[0, 1] > 2.0 * found[1, 1] and found[1, 0] > 2.0 * found[0, 0]
    alone = identify_campaign(folders["march"], Silent()).results
    # There over rows in which any joint moves, here over those in which the joint itself does.
    assert found[0, 0] == pytest.approx(alone.validation[0].overall_relative_error, rel=0.15)


def test_json_has_numbers_and_an_exit_status(folders: dict[str, Path], tmp_path: Path) -> None:
    pair = [str(folders["march"]), str(folders["june"])]
    page = tmp_path / "pages" / "compare.html"
    done = CliRunner().invoke(app, ["compare", *pair, "--json", "-o", str(page)])
    assert done.exit_code == 0
    found = json.loads(done.stdout, parse_constant=pytest.fail)
    assert found["simulated"] and found["changed"] and found["friction"]["changed"][0][1]
    assert [Path(one["folder"]).name for one in found["campaigns"]] == ["march", "june"]
    text = Page(page.read_text("utf-8")).text
    assert text.index("Changed: friction of shoulder") < text.index("SIMULATED")
    done = CliRunner().invoke(app, ["compare", *pair, "--quiet", "--fail-on-change"])
    assert (done.exit_code, done.stdout) == (5, "Changed: friction of shoulder.\n")


@pytest.mark.parametrize(
    ("other", "why"),
    [
        ("other", r"(march|other): is of another arm.*\[drive_train\]"),
        ("march", r"march.*only campaign.*give two"),
    ],
)
def test_refused_before_anything_is_estimated(
    folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, other: str, why: str
) -> None:
    """Different arms, whichever comes first, with what they differ in; one campaign."""
    monkeypatch.setattr("hil.batch.run._Batch", pytest.fail)
    with pytest.raises(InputError, match=why):
        compared(folders["march"], folders[other])


# From here on campaigns are made in memory.


def in_memory(
    *conditions: Condition,
    repetitions: Callable[[LevelEstimate], Array] = lambda level: np.array([level.values] * 2),
    folders: Sequence[str] = (),
) -> Comparison:
    levels = arm_histories.history(lambda k, _: conditions[k], len(conditions), seed=11)
    if folders:
        levels = [replace(o, campaign=f) for o, f in zip(levels, folders, strict=True)]
    single = [
        tuple(replace(level, level="repetition", values=own) for own in repetitions(level))
        for level in levels
    ]
    arm = Arm("digest", arm_histories.cell())
    return compare_campaigns(CampaignSet(arm, tuple(levels), tuple(single), ()))


def test_an_unstated_payload_is_weighed() -> None:
    found = in_memory(Condition(), Condition(load=Load(3.0)))
    assert found.verdict == "Changed: payload"
    assert found.payload.mass[1] == pytest.approx(3.0, abs=3.0 * found.payload.mass_std[1])


def test_scatter_of_repetitions_hides_a_small_change() -> None:
    def scattered(level: LevelEstimate) -> Array:
        random = np.random.default_rng(len(level.when) + int(level.campaign[-2:]))
        factor = np.ones((4, len(level.values)))
        factor[:, -FRICTION.size :] += 0.2 * random.standard_normal((4, 1))
        return factor * level.values

    raised = FRICTION.copy()
    raised[:, 3] *= 1.15
    more = Condition(), Condition(friction=raised)
    certain, uncertain = in_memory(*more), in_memory(*more, repetitions=scattered)
    assert np.flatnonzero(certain.friction.changed[:, 1]).tolist() == [3]
    assert not uncertain.changed
    limits = [o.friction.limit[3, 1] / o.friction.value[3, 0] for o in (certain, uncertain)]
    assert limits[0] < 0.15 < limits[1]


def test_a_change_too_small_to_matter_is_a_difference() -> None:
    found = in_memory(Condition(), Condition(friction=1.035 * FRICTION))
    slight = np.flatnonzero(found.friction.slight[:, 1])
    assert not found.changed and slight.size
    assert np.all(found.friction.p_value[slight, 1] < 0.005)
    assert np.all(np.abs(found.friction.shares[slight, 1, 0]) < 0.05)
    assert found.verdict.startswith("No change of 5 % or more; friction of ")
    less = [one.words for one in found.findings if "significant, but less than 5 %" in one.words]
    assert len(less) == len(slight) and {one.level for one in found.findings} == {"same"}
    (unchanged,) = (
        one.words
        for one in found.findings
        if one.words.startswith("Friction of") and "not changed" in one.words
    )
    for axis in (found.axes[j] for j in slight):
        assert any(axis.joint in words for words in less) and axis.joint not in unchanged


def test_campaigns_of_one_name_in_different_folders() -> None:
    found = in_memory(Condition(), Condition(), folders=("/runs/cold/b", "/runs/warm/b"))
    assert [name[:6] for name in found.names] == ["cold/b", "warm/b"]


def test_a_page_of_hostile_names_is_inert() -> None:
    found = in_memory(Condition(), Condition(friction=1.3 * FRICTION))
    spoilt = replace(
        found,
        arm=found.arm + HOSTILE,
        campaigns=tuple(replace(o, campaign=HOSTILE, setup=HOSTILE) for o in found.campaigns),
        names=(HOSTILE, HOSTILE),
        axes=tuple(replace(one, joint=one.joint + HOSTILE) for one in found.axes),
        parameters=(HOSTILE,) * len(found.parameters),
        warnings=(HOSTILE,),
    )
    assert_stands_alone(comparison_page(found).decode())
    assert_inert(Page(comparison_page(spoilt).decode()))


def test_undetermined_values_are_not_judged() -> None:
    first, second = arm_histories.history(lambda *_: Condition(), 2, seed=11)
    unknown = replace(second, std=np.full_like(second.std, np.inf), covariance=None)
    arm = Arm("digest", arm_histories.cell())
    levels = (first, unknown)
    again = compare_campaigns(CampaignSet(arm, levels, ((first,), (unknown,)), ()))
    assert not again.changed
    assert any("is not determined" in one.words for one in again.findings)
    assert any("one repetition" in warning for warning in again.warnings)
    assert "nan" not in Page(comparison_page(again).decode()).text
    json.dumps(again.document, allow_nan=False)


# The statistics by themselves.


def test_variance_and_count_of_correlated_repetitions() -> None:
    apart = np.array([9.0, 10.0, 11.0])
    assert figure(10.0, 0.01, 30.0, apart).variance == pytest.approx(1.0)
    assert figure(10.0, 4.0, 30.0, apart) == figure(10.0, 4.0, 30.0, apart[:1])
    assert np.isnan(figure(10.0, np.inf, 30.0, apart).value)
    drifting = np.linspace(0.0, 1.0, 30)
    assert effective_count(drifting) < 3.0
    random = np.random.default_rng(0)
    white = [effective_count(random.standard_normal(30)) for _ in range(200)]
    assert np.median(white) > 24.0
    assert effective_count(np.ones(30)) == 30.0
    assert effective_count(drifting[:3]) == 1.0  # too few to tell


@pytest.mark.parametrize(("count", "memory"), [(2, 0.0), (5, 0.7), (30, 0.0), (30, 0.7)])
def test_equal_campaigns_rarely_differ(count: int, memory: float) -> None:
    """At a level of 5 %, whether or not repetitions remember the one before."""
    random = np.random.default_rng(count)

    def one() -> Array:
        found = [random.standard_normal()]
        for shock in random.standard_normal(count - 1):
            found.append(memory * found[-1] + np.sqrt(1.0 - memory**2) * shock)
        return np.array(found)

    pairs = [[figure(own.mean(), 0.0, 30.0, own) for own in (one(), one())] for _ in range(2000)]
    found = [against_first([pair], 0.05).p_value[0, 1] for pair in pairs]
    assert np.mean(np.array(found) < 0.05) < 0.09


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_never_lowers_a_p_value(values: list[float]) -> None:
    found = holm(np.array([[np.nan, 0.01], [0.04, 0.03]]))
    np.testing.assert_allclose(found, [[np.nan, 0.03], [0.06, 0.06]])
    adjusted = holm(np.array(values))
    assert np.all(adjusted >= values) and adjusted.max() <= 1.0
    assert np.all(np.diff(adjusted[np.argsort(values, kind="stable")]) >= 0.0)
