"""Campaigns compared: planted changes are found, and nothing else; another arm is refused."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.batch.types import Arm, LevelEstimate
from hil.batch.workers import LocalWorkers
from hil.campaign import Campaign, CampaignPlan
from hil.campaign.plan import design
from hil.cell import Cell
from hil.cli import app
from hil.compare import Comparison, compare_campaigns, gather
from hil.compare.comparison import Gathered, against_first, effective_count, holm, known
from hil.errors import InputError
from hil.identify import identify_campaign
from hil.progress import Silent
from hil.report.changes import comparison_page

from . import arm_histories
from .arm_histories import FRICTION, Condition, Load
from .fast_cell import fast_cell
from .test_report import HOSTILE, Page, assert_inert, assert_stands_alone

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


def test_planted_friction_is_found_on_its_axis_and_nowhere_else(comparison: Comparison) -> None:
    friction = comparison.friction
    assert friction.changed.tolist() == [[False, True], [False, False]]
    change, low, high = friction.shares[0, 1]
    assert low < PLANTED - 1.0 < high and change == pytest.approx(PLANTED - 1.0, abs=0.02)
    assert comparison.verdict == "Changed: friction of shoulder"
    assert re.search("shoulder.* 29.9 % higher in june than in march", comparison.findings[0].words)


def test_the_first_place_is_what_others_are_compared_with(folders: dict[str, Path]) -> None:
    back = compared(folders["june"] / "results.json", folders["march"])
    assert back.names == ("june", "march")
    assert back.friction.shares[0, 1, 0] == pytest.approx(1.0 / PLANTED - 1.0, abs=0.02)


def test_each_model_is_tried_on_the_motions_of_the_other(
    comparison: Comparison, folders: dict[str, Path]
) -> None:
    found = comparison.prediction
    assert found[0, 1] > 2.0 * found[1, 1] and found[1, 0] > 2.0 * found[0, 0]
    alone = identify_campaign(folders["march"], Silent()).results
    # There over rows in which any joint moves, here over those in which the joint itself does.
    assert found[0, 0] == pytest.approx(alone.validation[0].overall_relative_error, rel=0.15)


def test_a_script_gets_numbers_and_an_exit_status(folders: dict[str, Path], tmp_path: Path) -> None:
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
        ("march", r"march.*only campaign.*name two"),
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
    return compare_campaigns(Gathered(arm, tuple(levels), tuple(single), not folders, ()))


def test_a_payload_that_nobody_stated_is_weighed() -> None:
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
    less = [one.words for one in found.findings if "less than the 5 % that count" in one.words]
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
    assert found.names == ("cold/b", "warm/b")


@pytest.mark.slow
def test_a_killed_run_that_was_made_good_is_no_warning(
    folders: dict[str, Path], tmp_path: Path
) -> None:
    killed = tmp_path / "killed"
    shutil.copytree(folders["june"], killed)
    (whole,) = killed.glob("archives/excitation_001_a1.mcap")
    later = whole.with_name("excitation_001_a2.mcap")
    manifest = killed / "manifest.json"
    whole.rename(later)
    manifest.write_text(manifest.read_text("utf-8").replace(whole.name, later.name), "utf-8")
    whole.write_bytes(later.read_bytes()[:5000])
    found = compared(folders["march"], killed)
    assert found.friction.changed.any()
    assert not any(whole.name in warning for warning in found.warnings)


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


def test_what_cannot_be_known_is_not_judged() -> None:
    first, second = arm_histories.history(lambda *_: Condition(), 2, seed=11)
    unknown = replace(second, std=np.full_like(second.std, np.inf), covariance=None)
    arm = Arm("digest", arm_histories.cell())
    levels = (first, unknown)
    again = compare_campaigns(Gathered(arm, levels, ((first,), (unknown,)), True, ()))
    assert not again.changed
    assert any("is not determined" in one.words for one in again.findings)
    assert any("one repetition" in warning for warning in again.warnings)
    assert "nan" not in Page(comparison_page(again).decode()).text
    json.dumps(again.document, allow_nan=False)


# The statistics by themselves.


def test_the_larger_of_two_variances_counts() -> None:
    apart = np.array([9.0, 10.0, 11.0])
    assert known(10.0, 0.01, 30.0, apart).variance == pytest.approx(1.0)
    assert known(10.0, 4.0, 30.0, apart) == known(10.0, 4.0, 30.0, apart[:1])
    assert np.isnan(known(10.0, np.inf, 30.0, apart).value)


def test_repetitions_that_drift_are_worth_few() -> None:
    drifting = np.linspace(0.0, 1.0, 30)
    assert effective_count(drifting) < 3.0
    random = np.random.default_rng(0)
    white = [effective_count(random.standard_normal(30)) for _ in range(200)]
    assert np.median(white) > 24.0
    assert effective_count(np.ones(30)) == 30.0
    assert effective_count(drifting[:3]) == 1.0  # nobody can tell


@pytest.mark.parametrize(("count", "memory"), [(2, 0.0), (5, 0.7), (30, 0.0), (30, 0.7)])
def test_of_two_alike_campaigns_few_are_said_to_differ(count: int, memory: float) -> None:
    """At a level of 5 %, whether or not repetitions remember the one before."""
    random = np.random.default_rng(count)

    def one() -> Array:
        found = [random.standard_normal()]
        for shock in random.standard_normal(count - 1):
            found.append(memory * found[-1] + np.sqrt(1.0 - memory**2) * shock)
        return np.array(found)

    pairs = [[known(own.mean(), 0.0, 30.0, own) for own in (one(), one())] for _ in range(2000)]
    found = [against_first([pair], 0.05).p_value[0, 1] for pair in pairs]
    assert np.mean(np.array(found) < 0.05) < 0.09


def test_holms_adjustment_is_that_of_the_book() -> None:
    found = holm(np.array([[np.nan, 0.01], [0.04, 0.03]]))
    np.testing.assert_allclose(found, [[np.nan, 0.03], [0.06, 0.06]])


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_holm_never_lowers_a_p_value_and_keeps_their_order(values: list[float]) -> None:
    adjusted = holm(np.array(values))
    assert np.all(adjusted >= values) and adjusted.max() <= 1.0
    assert np.all(np.diff(adjusted[np.argsort(values, kind="stable")]) >= 0.0)
