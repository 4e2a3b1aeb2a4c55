"""Campaigns of one arm compared: planted changes are found, and nothing else; page, statistics."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.base.progress import Silent
from hil.batch.cluster import Cluster
from hil.batch.estimates import BatchArm
from hil.batch.setup import Setup
from hil.campaign import Campaign
from hil.campaign.plan import design
from hil.cell import Cell
from hil.cli import app
from hil.compare.changes_page import comparison_page
from hil.compare.comparison import (
    against_first,
    compare,
    compare_campaigns,
    effective_count,
    figure,
    holm,
    quantities,
)
from hil.compare.documents import comparison_document
from hil.compare.messages import verdict_line
from hil.compare.notes import CampaignName, OtherSetups, SingleRepetition
from hil.pipeline.notes import StatedText
from identification.model.motion import Motion
from tests.hil import arm_histories
from tests.hil.arm_histories import FRICTION, Condition
from tests.hil.fast_cell import fast_cell
from tests.hil.report.pages import HOSTILE, Page, assert_inert, assert_stands_alone

pytestmark = pytest.mark.long

Array = NDArray[np.float64]

MORE = 1.3
"""Factor on the shoulder's friction in the second campaign."""
SIMULATED = "coulomb = [6.0, 3.0]\nviscous = [3.0, 1.5]\nthird"


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Two campaigns of one arm, the second with more friction, and one of another arm."""
    root = tmp_path_factory.mktemp("compared")
    usual = fast_cell(root, repetitions=3)
    plan = design(usual, Silent())
    changed = f"coulomb = [{6.0 * MORE}, 3.0]\nviscous = [{3.0 * MORE}, 1.5]\nthird"
    stiff = usual.text.replace(SIMULATED, changed).replace("seed = 3", "seed = 4")
    other = usual.text.replace("gear_ratio = [100.0", "gear_ratio = [110.0")
    assert stiff != usual.text != other
    return {
        name: ran(root / name, Cell.from_texts(text, usual.urdf, usual.path), plan)
        for name, text in (("march", usual.text), ("june", stiff), ("other", other))
    }


def ran(folder, cell, plan):
    Campaign.create(folder, cell, plan).run(unrehearsed=True, durable=False)
    return folder


def compared(*places):
    with Cluster() as cluster:
        return compare([str(place) for place in places], cluster, Silent())


class TestRecorded:
    """Campaigns from their archives."""

    @pytest.mark.parametrize("order", [("march", "june/results.json"), ("june", "march")])
    def test_changed_friction_is_found_on_its_axis_only(self, folders, order):
        """The first campaign given is the reference."""
        comparison = compared(*(folders["march"].parent / name for name in order))
        assert comparison.names == tuple(CampaignName(name.split("/")[0]) for name in order)
        factor = MORE if order[0] == "march" else 1.0 / MORE
        assert {(entry.kind, entry.axis) for entry in comparison.changed} == {
            ("friction", "shoulder")
        }
        (change,) = comparison.changed
        assert abs(change.change) - change.half < abs((factor - 1.0) * change.before)
        assert change.after / change.before == pytest.approx(factor, abs=0.02)
        assert verdict_line(comparison.changed) == "Changed: friction of shoulder"

    def test_json_has_numbers_and_an_exit_status(self, folders, tmp_path):
        pair = [str(folders["march"]), str(folders["june"])]
        page = tmp_path / "pages" / "compare.html"
        done = CliRunner().invoke(app, ["compare", *pair, "--json", "-o", str(page)])
        assert done.exit_code == 0
        printed = json.loads(done.stdout, parse_constant=pytest.fail)
        assert printed["simulated"] and printed["changed"]
        assert [o["axis"] for o in printed["parameters"] if o["changed"]] == ["shoulder"]
        assert [Path(campaign["folder"]).name for campaign in printed["campaigns"]] == [
            "march",
            "june",
        ]
        text = Page(page.read_text("utf-8")).text
        assert text.index("friction of shoulder") < text.index("SIMULATED")
        done = CliRunner().invoke(app, ["compare", *pair, "--quiet", "--fail-on-change"])
        assert done.exit_code == 5
        assert done.stdout == f"{printed['verdict']}.\n"

    def test_the_screen_names_reference_intervals_and_report(self, folders, tmp_path):
        page = tmp_path / "compare.html"
        pair = [str(folders["march"]), str(folders["june"])]
        done = CliRunner().invoke(app, ["compare", *pair, "-o", str(page)])
        assert "june compared with march: " in done.stdout
        assert "95 % interval of a change of friction: ±" in done.stdout
        assert done.stdout.count("compare.html") == 1

    @pytest.mark.parametrize(
        ("other", "why"),
        [
            ("other", r"(march|other): belongs to another arm.*\[drive_train\]"),
            ("march", r"march.*only campaign.*give two"),
        ],
    )
    def test_refused_before_anything_is_estimated(self, folders, monkeypatch, other, why):
        """Different arms, whichever comes first, with what they differ in; one campaign."""
        monkeypatch.setattr("hil.batch.graph._Batch", pytest.fail)
        with pytest.raises(InputError, match=why):
            compared(folders["march"], folders[other])

    def test_a_copy_is_no_second_campaign(self, folders, tmp_path):
        copy = shutil.copytree(folders["march"], tmp_path / "copy")
        with pytest.raises(InputError, match=r"only campaign given, as .*mcap is a copy of .*mcap"):
            compared(folders["march"], copy)


def equal(level):
    return np.array([level.estimate.values] * 2)


def scattered(level):
    """Repetitions with 20 % scatter of the friction."""
    random = np.random.default_rng(len(level.when) + int(level.campaign[-2:]))
    values = level.estimate.values
    factor = np.ones((4, len(values)))
    factor[:, -FRICTION.size :] += 0.2 * random.standard_normal((4, 1))
    return factor * values


def levels_of(*conditions):
    return arm_histories.history(lambda k, _: conditions[k], len(conditions), seed=11)


def judged(levels, repetitions=equal):
    """Compare campaigns with repetitions of these values."""
    single = [
        [
            replace(level, estimate=replace(level.estimate, values=values))
            for values in repetitions(level)
        ]
        for level in levels
    ]
    return compare_campaigns(BatchArm("digest", arm_histories.cell()), levels, single)


def in_memory(friction=1.0, *, load=0.0, repetitions=equal):
    """Compare a usual campaign with one of other friction or load."""
    other = Condition(friction=friction * FRICTION, load=load)
    return judged(levels_of(Condition(), other), repetitions)


class TestInMemory:
    """Campaigns made in memory."""

    def test_a_payload_changes_the_inertia_of_its_link(self):
        comparison = in_memory(load=3.0)
        assert {change.kind for change in comparison.changed} == {"inertia"}
        assert "joint_6" in {change.axis for change in comparison.changed}
        assert not in_memory().changed

    def test_quantities_are_inertial_parameters_and_friction_of_axes(self):
        """Friction is the mean of both directions."""
        arm = arm_histories.model()
        (level,) = levels_of(Condition())
        compared = quantities(arm, level)
        axes = {quantity.name: quantity.axis for quantity in compared if quantity.kind == "inertia"}
        assert len(compared) == arm.base.rank + 6
        assert all(name.startswith("I") for name, axis in axes.items() if not axis)
        assert [axes[name] for name in ("mc2x", "I5xz")] == ["joint_2", "joint_5"]
        values = np.random.default_rng(1).uniform(0.1, 2.0, arm.n_parameters)
        values[: arm.base.rank] = 0.0
        still = Motion.at_rest(np.zeros((1, 6)))
        for j, quantity in enumerate(q for q in compared if q.kind == "friction"):
            speed = np.zeros((1, 6))
            speed[0, j] = float(quantity.name.split()[-2])
            both = [
                arm.torque(values, replace(still, velocity=sign * speed))[0, j]
                for sign in (1.0, -1.0)
            ]
            assert quantity.weights @ values == pytest.approx(0.5 * (both[0] - both[1]), rel=0.05)

    def test_scatter_of_repetitions_hides_a_change(self):
        certain = in_memory(1.5)
        uncertain = in_memory(1.5, repetitions=scattered)
        assert {change.axis for change in certain.changed} == {f"joint_{j}" for j in range(1, 7)}
        assert not uncertain.changed

    def test_a_change_too_small_to_matter_is_none(self):
        comparison = in_memory(1.035)
        slight = [change for change in comparison.changes if change.p_value < 0.01]
        assert slight and not comparison.changed
        assert all(abs(change.change) < 0.05 * abs(change.before) for change in slight)

    def test_names_have_folders_and_stated_payloads(self):
        first, other = levels_of(Condition(), Condition())
        folders = [replace(first, campaign="/runs/cold/b"), replace(other, campaign="/runs/warm/b")]
        names = judged(folders).names
        assert [(name.folder, name.setup) for name in names] == [("cold/b", None), ("warm/b", None)]
        carried = Setup(mass=3.0, centre=(0.0, 0.0, 0.1))
        laden = replace(other, setup=carried, campaign=first.campaign)
        comparison = judged([first, laden])
        assert [name.setup for name in comparison.names] == [Setup(), carried]
        setups = zip(comparison.names, (Setup(), carried), strict=True)
        assert comparison.warnings[0] == OtherSetups(tuple(setups))

    def test_a_page_of_hostile_names_is_inert(self):
        comparison = in_memory(1.3)
        spoilt = replace(
            comparison,
            arm=comparison.arm + HOSTILE,
            campaigns=tuple(
                replace(o, campaign=HOSTILE, setup=Setup(centre=(0.0,), frame=HOSTILE))
                for o in comparison.campaigns
            ),
            names=(CampaignName(HOSTILE), CampaignName(HOSTILE)),
            changes=tuple(
                replace(change, parameter=HOSTILE, axis=HOSTILE, campaign=CampaignName(HOSTILE))
                for change in comparison.changes
            ),
            warnings=(StatedText(HOSTILE),),
        )
        assert_stands_alone(comparison_page(comparison).decode())
        assert_inert(Page(comparison_page(spoilt).decode()), charts=False)

    def test_undetermined_values_are_not_judged(self):
        first, second = levels_of(Condition(), Condition())
        infinite = np.diag(np.full_like(second.estimate.std, np.inf))
        unknown = replace(second, estimate=replace(second.estimate, covariance=infinite))
        again = judged([first, unknown], lambda level: [level.estimate.values])
        assert not again.changed
        assert {SingleRepetition(name) for name in again.names} <= {*again.warnings}
        assert "nan" not in Page(comparison_page(again).decode()).text
        json.dumps(comparison_document(again), allow_nan=False)


class TestStatistics:
    """Variances and tests by themselves."""

    def test_variance_and_count_of_correlated_repetitions(self):
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
        assert effective_count(drifting[:3]) == 1.0  # too few to estimate a correlation

    @pytest.mark.parametrize(("count", "memory"), [(2, 0.0), (5, 0.7), (30, 0.0), (30, 0.7)])
    def test_equal_campaigns_rarely_differ(self, count, memory):
        """At a level of 5 %, whether or not repetitions remember the one before."""
        random = np.random.default_rng(count)

        def one():
            estimates = [random.standard_normal()]
            for shock in random.standard_normal(count - 1):
                estimates.append(memory * estimates[-1] + np.sqrt(1.0 - memory**2) * shock)
            return np.array(estimates)

        pairs = [
            [[figure(estimates.mean(), 0.0, 30.0, estimates)] for estimates in (one(), one())]
            for _ in range(2000)
        ]
        p_values = [against_first(np.array(pair))[2][1, 0] for pair in pairs]
        assert np.mean(np.array(p_values) < 0.05) < 0.09

    @given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
    def test_holm_never_lowers_a_p_value(self, values):
        corrected = holm(np.array([[np.nan, 0.01], [0.04, 0.03]]))
        np.testing.assert_allclose(corrected, [[np.nan, 0.03], [0.06, 0.06]])
        adjusted = holm(np.array(values))
        assert np.all(adjusted >= values) and adjusted.max() <= 1.0
        assert np.all(np.diff(adjusted[np.argsort(values, kind="stable")]) >= 0.0)
