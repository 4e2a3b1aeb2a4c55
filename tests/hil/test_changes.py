"""Campaigns of one arm compared: planted changes are found, and nothing else; page, statistics."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.batch.run import Arm, LevelEstimate
from hil.batch.workers import LocalWorkers
from hil.campaign import Campaign, CampaignPlan
from hil.campaign.plan import design
from hil.cell import Cell
from hil.cli import app
from hil.compare import (
    CampaignSet,
    Comparison,
    against_first,
    compare_campaigns,
    effective_count,
    figure,
    gather,
    holm,
    quantities,
)
from hil.errors import InputError
from hil.progress import Silent
from hil.report.changes import comparison_page

from . import arm_histories
from .arm_histories import FRICTION, Condition, Load
from .fast_cell import fast_cell
from .test_report import HOSTILE, Page, assert_inert, assert_stands_alone

Array = NDArray[np.float64]

MORE = 1.3
"""Factor on the shoulder's friction in the second campaign."""
SIMULATED = "coulomb = [6.0, 3.0]\nviscous = [3.0, 1.5]\nthird"


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
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


def ran(folder: Path, cell: Cell, plan: CampaignPlan) -> Path:
    Campaign.create(folder, cell, plan).run(unrehearsed=True, durable=False)
    return folder


def compared(*places: Path) -> Comparison:
    with LocalWorkers(1) as workers:
        return compare_campaigns(gather([str(p) for p in places], workers, Silent()))


class TestRecorded:
    """Campaigns from their archives."""

    @pytest.mark.parametrize("order", [("march", "june/results.json"), ("june", "march")])
    def test_changed_friction_is_found_on_its_axis_only(
        self, folders: dict[str, Path], order: tuple[str, str]
    ) -> None:
        """The first campaign given is the reference."""
        found = compared(*(folders["march"].parent / name for name in order))
        assert found.names == tuple(name.split("/")[0] for name in order)
        factor = MORE if order[0] == "march" else 1.0 / MORE
        assert {(one.kind, one.axis) for one in found.changed} == {("friction", "shoulder")}
        (one,) = found.changed
        assert abs(one.change) - one.half < abs((factor - 1.0) * one.before)
        assert one.after / one.before == pytest.approx(factor, abs=0.02)
        assert found.verdict == "Changed: friction of shoulder"

    def test_json_has_numbers_and_an_exit_status(
        self, folders: dict[str, Path], tmp_path: Path
    ) -> None:
        pair = [str(folders["march"]), str(folders["june"])]
        page = tmp_path / "pages" / "compare.html"
        done = CliRunner().invoke(app, ["compare", *pair, "--json", "-o", str(page)])
        assert done.exit_code == 0
        found = json.loads(done.stdout, parse_constant=pytest.fail)
        assert found["simulated"] and found["changed"]
        assert [o["axis"] for o in found["parameters"] if o["changed"]] == ["shoulder"]
        assert [Path(one["folder"]).name for one in found["campaigns"]] == ["march", "june"]
        text = Page(page.read_text("utf-8")).text
        assert text.index("friction of shoulder") < text.index("SIMULATED")
        done = CliRunner().invoke(app, ["compare", *pair, "--quiet", "--fail-on-change"])
        assert done.exit_code == 5
        assert done.stdout == f"{found['verdict']}.\n"

    @pytest.mark.parametrize(
        ("other", "why"),
        [
            ("other", r"(march|other): is of another arm.*\[drive_train\]"),
            ("march", r"march.*only campaign.*give two"),
        ],
    )
    def test_refused_before_anything_is_estimated(
        self, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch, other: str, why: str
    ) -> None:
        """Different arms, whichever comes first, with what they differ in; one campaign."""
        monkeypatch.setattr("hil.batch.run._Batch", pytest.fail)
        with pytest.raises(InputError, match=why):
            compared(folders["march"], folders[other])


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
    return compare_campaigns(CampaignSet(arm, tuple(levels), tuple(single)))


class TestInMemory:
    """Campaigns made in memory."""

    def test_a_payload_changes_the_inertia_of_its_link(self) -> None:
        found = in_memory(Condition(), Condition(load=Load(3.0)))
        assert {one.kind for one in found.changed} == {"inertia"}
        assert "joint_6" in {one.axis for one in found.changed}
        assert not in_memory(Condition(), Condition()).changed

    def test_every_inertial_parameter_of_a_link_has_its_axis(self) -> None:
        model, level = arm_histories.model(), arm_histories.history(arm_histories.steady, 1, 1)[0]
        found = quantities(model, level)
        axes = {one.name: one.axis for one in found if one.kind == "inertia"}
        assert len(found) == model.base.rank + 6
        assert all(name.startswith("I") for name, axis in axes.items() if not axis)
        assert [axes[name] for name in ("mc2x", "I5xz")] == ["joint_2", "joint_5"]

    def test_friction_of_an_axis_is_the_mean_of_both_directions(self) -> None:
        arm, level = arm_histories.model(), arm_histories.history(arm_histories.steady, 1, 1)[0]
        values = np.random.default_rng(1).uniform(0.1, 2.0, arm.n_parameters)
        values[: arm.base.rank] = 0.0
        still = np.zeros((1, 6))
        for j, one in enumerate(q for q in quantities(arm, level) if q.kind == "friction"):
            speed = still.copy()
            speed[0, j] = float(one.name.split()[-2])
            both = [arm.torque(values, still, sign * speed, still)[0, j] for sign in (1.0, -1.0)]
            assert one.weights @ values == pytest.approx(0.5 * (both[0] - both[1]), rel=0.05)

    def test_scatter_of_repetitions_hides_a_change(self) -> None:
        def scattered(level: LevelEstimate) -> Array:
            random = np.random.default_rng(len(level.when) + int(level.campaign[-2:]))
            factor = np.ones((4, len(level.values)))
            factor[:, -FRICTION.size :] += 0.2 * random.standard_normal((4, 1))
            return factor * level.values

        more = Condition(), Condition(friction=1.5 * FRICTION)
        certain, uncertain = in_memory(*more), in_memory(*more, repetitions=scattered)
        assert {one.axis for one in certain.changed} == {f"joint_{j}" for j in range(1, 7)}
        assert not uncertain.changed

    def test_a_change_too_small_to_matter_is_none(self) -> None:
        found = in_memory(Condition(), Condition(friction=1.035 * FRICTION))
        slight = [one for one in found.changes if one.p_value < 0.01]
        assert slight and not found.changed
        assert all(abs(one.change) < 0.05 * abs(one.before) for one in slight)

    def test_campaigns_of_one_name_in_different_folders(self) -> None:
        found = in_memory(Condition(), Condition(), folders=("/runs/cold/b", "/runs/warm/b"))
        assert [name[:6] for name in found.names] == ["cold/b", "warm/b"]

    def test_different_payloads_stated_are_named(self) -> None:
        levels = arm_histories.history(lambda *_: Condition(), 2, seed=11)
        laden = replace(levels[1], setup="carries 3 kg", campaign=levels[0].campaign)
        arm = Arm("digest", arm_histories.cell())
        found = compare_campaigns(CampaignSet(arm, (levels[0], laden), ((), ())))
        assert "carries 3 kg" in found.names[1] and "carries 3 kg" in found.warnings[0]

    def test_a_page_of_hostile_names_is_inert(self) -> None:
        found = in_memory(Condition(), Condition(friction=1.3 * FRICTION))
        spoilt = replace(
            found,
            arm=found.arm + HOSTILE,
            campaigns=tuple(replace(o, campaign=HOSTILE, setup=HOSTILE) for o in found.campaigns),
            names=(HOSTILE, HOSTILE),
            changes=tuple(
                replace(one, parameter=HOSTILE, axis=HOSTILE, campaign=HOSTILE)
                for one in found.changes
            ),
            warnings=(HOSTILE,),
        )
        assert_stands_alone(comparison_page(found).decode())
        assert_inert(Page(comparison_page(spoilt).decode()))

    def test_undetermined_values_are_not_judged(self) -> None:
        first, second = arm_histories.history(lambda *_: Condition(), 2, seed=11)
        unknown = replace(second, std=np.full_like(second.std, np.inf), covariance=None)
        arm = Arm("digest", arm_histories.cell())
        again = compare_campaigns(CampaignSet(arm, (first, unknown), ((first,), (unknown,))))
        assert not again.changed
        assert any("one repetition" in warning for warning in again.warnings)
        assert "nan" not in Page(comparison_page(again).decode()).text
        json.dumps(again.document, allow_nan=False)


class TestStatistics:
    """Variances and tests by themselves."""

    def test_variance_and_count_of_correlated_repetitions(self) -> None:
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
    def test_equal_campaigns_rarely_differ(self, count: int, memory: float) -> None:
        """At a level of 5 %, whether or not repetitions remember the one before."""
        random = np.random.default_rng(count)

        def one() -> Array:
            found = [random.standard_normal()]
            for shock in random.standard_normal(count - 1):
                found.append(memory * found[-1] + np.sqrt(1.0 - memory**2) * shock)
            return np.array(found)

        pairs = [
            [[figure(own.mean(), 0.0, 30.0, own)] for own in (one(), one())] for _ in range(2000)
        ]
        p_values = [against_first(np.array(pair))[2][1, 0] for pair in pairs]
        assert np.mean(np.array(p_values) < 0.05) < 0.09

    @given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
    def test_holm_never_lowers_a_p_value(self, values: list[float]) -> None:
        found = holm(np.array([[np.nan, 0.01], [0.04, 0.03]]))
        np.testing.assert_allclose(found, [[np.nan, 0.03], [0.06, 0.06]])
        adjusted = holm(np.array(values))
        assert np.all(adjusted >= values) and adjusted.max() <= 1.0
        assert np.all(np.diff(adjusted[np.argsort(values, kind="stable")]) >= 0.0)
