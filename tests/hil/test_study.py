"""The paper's study: statistics, sentences made from numbers, and a whole one on a small arm."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.batch.workers import LocalWorkers
from hil.campaign import CampaignFolder
from hil.campaign.plan import moves_from_dict
from hil.cell import Cell
from hil.cli import app
from hil.errors import InputError, OperatorStopError
from hil.progress import Silent
from hil.simulation import planted_values
from hil.study import QUICK, StudyResults, StudySettings, run_study, study_settings
from hil.study.campaigns import (
    AP,
    B0,
    PRINTED_SINES,
    SINES,
    A,
    B,
    Execution,
    Plans,
    Search,
    StudyError,
    best_sines,
    execute,
    in_children,
)
from hil.study.page import study_page
from hil.study.records import PLANTED, ClassForms, ExampleRecord, FitRecord, MotionForm, ScoreRecord
from hil.study.results import (
    ConditionResult,
    EqualDataResult,
    StudyParameter,
    conclusions,
    summary_of,
)
from hil.study.settings import Effort
from hil.study.statistics import (
    MIN_REPETITIONS,
    compared_on,
    corrected,
    parameter_error,
    ranges_of,
    spread,
    verdict_of,
)
from hil.study.tables import (
    Condition,
    compared_pairs,
    condition_result,
    equal_data,
    estimates_of,
    parameters_of,
)
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_cell
from tests.hil.test_report import assert_stands_alone

Array = NDArray[np.float64]
Whole = tuple[Path, StudyResults]

# Numbers of which the errors are known beforehand


def fitted(values: Array, duration: float = 8.0) -> FitRecord:
    """Repetitions of one excitation with these estimates (r, p)."""
    n = values.shape[1]
    return FitRecord(
        inputs="",
        repetitions=[f"excitation_{k:03d}_a1.mcap" for k in range(len(values))],
        values=values.tolist(),
        pooled=values.mean(axis=0).tolist(),
        pooled_std=[0.1] * n,
        undetermined=[],
        log10_det=50.0,
        coupling_index=3.0,
        n_samples=100,
        correlation=np.eye(n).tolist(),
        duration=duration,
        time=[0.0, 1.0],
        position=[[0.0, 1.0]] * 2,
    )


def flagged(count: int, of: int, repetitions: int, noise: float = 0.0) -> Array:
    """Estimates (r, of) of method `count`: its own parameter is 1 but for noise, the others 0."""
    random = np.random.default_rng([0, count])
    return np.eye(of)[count] + noise * random.standard_normal((repetitions, of))


def scored(errors: Mapping[str, Array]) -> ScoreRecord:
    """Motions on which the k-th method, whose own parameter is 1, has these errors (m,)."""
    table, line = np.array(list(errors.values())), [[0.0, 1.0]] * 2
    motions = table.shape[1]
    example = {"archive": "v.mcap", "time": [0.0, 1.0], "measured": line}
    return ScoreRecord(
        inputs="",
        durations=[10.0] * motions,
        left_out=[0.1, 0.3],
        forms=[form(np.diag([*column, 0.0]) ** 2) for column in table.T],
        all_rows={name: [0.04] * motions for name in (*errors, PLANTED)},
        mean_abs={name: np.outer(values, [1.0, 2.0]).tolist() for name, values in errors.items()},
        examples=[ExampleRecord(**example, predicted=dict.fromkeys(errors, line))],
    )


def form(gram: Array) -> MotionForm:
    """A motion with this Gram of [Phi | tau] (p + 1, p + 1)."""
    whole = gram[:-1, :-1].tolist()
    return MotionForm(archive="v.mcap", torque_squared=1.0, slow=gram.tolist(), whole=whole)


def forms_of(*grams: Array) -> ClassForms:
    """Motions with these Grams."""
    return ClassForms.of([form(gram) for gram in grams])


def random_forms(motions: int, n: int) -> ClassForms:
    """Motions with torque that parameters (n,) of 0 predict exactly."""
    random = np.random.default_rng(0)
    tables = random.standard_normal((motions, 40, n)) * random.uniform(1, 3, (motions, 1, 1))
    return forms_of(*(np.pad(table.T @ table, (0, 1)) for table in tables))


class TestErrors:
    """Errors of estimates from the quadratic forms of motions."""

    def test_a_form_gives_the_error_of_any_mean_of_estimates(self) -> None:
        random = np.random.default_rng(1)
        phi, tau = random.standard_normal((50, 3)), random.standard_normal(50)
        table = np.column_stack([phi, tau])
        forms = forms_of(table.T @ table)
        values = random.standard_normal((4, 3))
        mean = values.mean(axis=0)
        left = np.linalg.norm(tau - phi @ mean)  # over torque of 1
        assert forms.overall(mean) == pytest.approx([left])
        assert np.sqrt(forms.torque_kernels(values).mean()) == pytest.approx(left)
        away = np.linalg.norm(phi @ (mean - 1.0))
        assert forms.own(mean, np.ones(3)) == pytest.approx([away])
        assert np.sqrt(forms.own_kernels(values, np.ones(3)).mean()) == pytest.approx(away)

    def test_the_longer_excitation_is_cut_to_equal_duration(self) -> None:
        short = fitted(np.ones((6, 4)))
        fits = {"a": fitted(np.arange(24.0).reshape(6, 4), 20.0), "b": short}  # 120 s and 48 s
        equal = equal_data(fits)
        assert (equal.cut, equal.repetitions, equal.seconds) == ("a", 2, 40.0)
        assert (equal.other, equal.other_seconds) == ("b", 48.0)
        assert estimates_of(fits)["a-equal"].tolist() == [2.0, 3.0, 4.0, 5.0]
        assert equal_data({"a": short, "b": short}) is None

    def test_the_distance_of_the_base_itself_is_one(self) -> None:
        truth, base = np.zeros(3), np.array([1.0, -2.0, 3.0])
        assert parameter_error(base, base, truth) == pytest.approx(1.0)
        assert parameter_error(-0.5 * base, base, truth) == pytest.approx(0.5)
        assert parameter_error(truth, base, truth) is None

    def test_the_range_contains_other_repetitions(self) -> None:
        forms, values = {"fly-by": random_forms(5, 4)}, flagged(0, 4, 6, 0.1)
        found = ranges_of("b", values, 1, forms, np.zeros(4), values[0])
        bands = {one.quantity: one for one in found}
        singles = [float(np.median(forms["fly-by"].overall(one))) for one in values]
        error = bands["error"]
        assert (error.low, error.high) == pytest.approx((min(singles), max(singles)))
        assert error.subsets == 6
        assert bands["own"].low == pytest.approx(error.low)
        assert bands["parameter_error"].low <= 1.0 <= bands["parameter_error"].high
        assert ranges_of("b", values, 6, forms, np.zeros(4), values[0]) == []

    def test_planted_values_in_printed_units_are_the_manufacturers(self) -> None:
        cell = Cell.load(CELL_PATH)
        printed = [one for one in parameters_of(cell, planted_values(cell)) if one.printed_id]
        known = [one for one in printed if one.printed_c is not None]
        assert len(printed) == 58 and len(known) == 52
        for one in known:
            assert one.truth is not None and one.printed_c is not None
            assert one.printed_factor * one.truth == pytest.approx(one.printed_c, abs=6e-4), one


class TestSpread:
    """What other motions and other repetitions would have changed."""

    def test_equal_repetitions_leave_the_scatter_of_motions(self) -> None:
        logs = np.random.default_rng(3).normal(0.1, 0.3, 12)
        same = np.ones((12, 4, 4))
        found = spread(same, same * np.exp(2.0 * logs)[:, None, None], drifts=False, seed=0)
        assert found[1] == pytest.approx(11.0)
        # A standard deviation of 4000 draws is known to about 1 %.
        assert found[0] == pytest.approx(stats.sem(logs), rel=0.05)

    def test_noise_of_estimates_does_not_vanish_with_more_motions(self) -> None:
        few, many = (
            spread(
                *(random_forms(m, 6).torque_kernels(flagged(k, 6, 5, 0.2)) for k in (0, 1)),
                drifts=False,
                seed=0,
            )
            for m in (10, 160)
        )
        assert many[0] > 0.5 * few[0]  # over motions alone it would fall to a quarter

    @pytest.mark.parametrize("repetitions", [3, 10])
    @pytest.mark.parametrize("off", [0.0, 3.0])
    def test_a_method_seldom_differs_from_itself(self, repetitions: int, off: float) -> None:
        trials, differ = 60, 0
        random, forms = np.random.default_rng(4), random_forms(10, 12)
        for _ in range(trials):
            values = [off + random.standard_normal((repetitions, 12)) for _ in range(2)]
            inner = forms.torque_kernels(values[0]), forms.torque_kernels(values[1])
            differ += compared_on("fly-by", ("a", "b"), inner, drifts=False).differs
        # At 5 %, or less, so many are exceeded once in 1000 times.
        assert differ <= stats.binom(trials, 0.05).ppf(0.999)

    def test_a_difference_that_exists_is_found(self) -> None:
        forms, random = random_forms(10, 12), np.random.default_rng(5)
        near, far = (off + 0.02 * random.standard_normal((10, 12)) for off in (1.0, 1.2))
        inner = forms.torque_kernels(near), forms.torque_kernels(far)
        one = compared_on("fly-by", ("a", "b"), inner, drifts=False)
        assert one.ratio == pytest.approx(1.2, rel=0.02)
        assert one.low is not None and one.low > 1.15
        assert (one.verdict, one.repetitions) == ("worse", [10, 10])
        assert compared_on("fly-by", ("b", "a"), inner[::-1], drifts=False).verdict == "better"
        zero = np.zeros(12)
        own_errors = forms.own_kernels(near, zero), forms.own_kernels(far, zero)
        own = compared_on("fly-by", ("a", "b"), own_errors, drifts=False)
        assert own.ratio == pytest.approx(one.ratio)  # these torques are those of parameters of 0

    def test_correlated_repetitions_count_as_blocks(self) -> None:
        forms, random = random_forms(10, 4), np.random.default_rng(6)
        slow = np.repeat(random.standard_normal((9, 4)), 3, axis=0)
        other = 1.0 + random.standard_normal((27, 4))
        inner = forms.torque_kernels(1.0 + slow), forms.torque_kernels(other)
        single, blocks = (spread(*inner, drifts=drifts, seed=0) for drifts in (False, True))
        assert blocks[0] > 1.1 * single[0]
        assert blocks[1] < single[1]

    @pytest.mark.parametrize(
        ("repetitions", "motions"), [(MIN_REPETITIONS - 1, 10), (1, 10), (5, 1)]
    )
    def test_too_few_repetitions_or_motions(self, repetitions: int, motions: int) -> None:
        forms = random_forms(motions, 4)
        a, b = (forms.torque_kernels(flagged(k, 4, repetitions, 0.01)) for k in range(2))
        one = compared_on("fly-by", ("a", "b"), (a, b), drifts=False)
        assert (one.verdict, one.low, one.high, one.error) == ("too few", None, None, None)
        assert not one.differs


class TestVerdict:
    """Tests of ratios, and tables of them."""

    @pytest.mark.parametrize(
        ("ratio", "low", "high", "verdict"),
        [
            (0.9, 0.8, 0.99, "better"),
            (0.985, 0.98, 0.99, "slightly better"),
            (0.9, 0.8, 1.0, "none"),
            (1.01, 1.001, 1.02, "slightly worse"),
            (1.3, 1.1, 1.5, "worse"),
            (1.3, None, None, "too few"),
        ],
    )
    def test_it_is_that_of_the_interval(
        self, ratio: float, low: float | None, high: float | None, verdict: str
    ) -> None:
        assert verdict_of(ratio, low, high) == verdict

    def test_intervals_of_a_larger_table_are_wider(self) -> None:
        error = 0.1 / stats.t.ppf(0.985, 8.0)  # leaves out 1 at 97 %
        inner = np.ones((4, 3, 3)), np.ones((4, 3, 3))
        one = compared_on("fly-by", ("a", "b"), inner, drifts=False)
        own = {"ratio": np.exp(0.1), "error": error, "freedom": 8.0}
        (alone,) = corrected([one.model_copy(update=own)])
        among = corrected([one.model_copy(update=own)] * 4)
        assert (alone.level, alone.verdict) == (0.95, "worse")
        assert (among[0].level, among[0].verdict) == (0.9875, "none")
        assert alone.low is not None and alone.low > 1.0
        assert among[0].low is not None and among[0].low < 1.0

    def test_the_printed_sines_are_compared_with_b_alone(self) -> None:
        assert compared_pairs([A, B, B0]) == [(A, B), (A, B0), (B, B0)]
        assert compared_pairs([A, B, B0, AP]) == [(A, B), (A, B0), (B, B0), (AP, B)]


WITHOUT_EFFECTS = Condition("plain", "without unmodelled effects", (), drifts=False)
EFFECTS = Condition("effects", "with unmodelled effects", ("ripple",), drifts=False)
PARAMETERS = [StudyParameter(name=f"p{k}", unit="kg", truth=0.0) for k in range(2)]


def condition(
    ratio: float,
    *,
    named: Condition = WITHOUT_EFFECTS,
    scatter: float = 0.05,
    repetitions: int = 5,
    noise: float = 0.01,
) -> ConditionResult:
    """The second method's errors are so many times the first's, but for scatter over motions."""
    random = np.random.default_rng(5)
    a = random.uniform(0.01, 0.03, 30)
    b = ratio * a * np.exp(scatter * random.standard_normal(30))
    methods = {"a": a, "b": b}
    return condition_result(
        named,
        {key: fitted(flagged(k, 2, repetitions, noise)) for k, key in enumerate(methods)},
        {"fly-by": scored(methods)},
        PARAMETERS,
    )


def study(*conditions: ConditionResult) -> StudyResults:
    results = StudyResults(
        name="made up", cell="arm", simulated=True, quick=False, settings=QUICK, software={},
        joint_names=["hip", "knee"], n_base=2, parameters=PARAMETERS, searches=[], table1=[],
        conditions=list(conditions), ablations=[], ranges=[], reading=[], missing=[], times={},
    )  # fmt: skip
    return results.model_copy(update={"reading": conclusions(results)})


def text_of(results: StudyResults) -> str:
    return " ".join(text for one in results.reading for text in (one.verdict, *one.sentences))


class TestConclusion:
    """What the numbers say."""

    @pytest.mark.parametrize(
        ("made", "verdict"),
        [
            ({"ratio": 0.8}, "B is better, its error 21 % smaller."),
            ({"ratio": 1.25}, "A is better, its error 19 % smaller."),
            ({"ratio": 0.99, "scatter": 0.002, "noise": 1e-3}, "B is slightly better, its"),
            ({"ratio": 1.0, "scatter": 0.3}, "No significant difference."),
            ({"ratio": 0.8, "repetitions": 1}, "Too few repetitions or motions"),
        ],
    )
    def test_a_difference_has_direction_and_size(self, made: dict[str, Any], verdict: str) -> None:
        results = study(condition(**made))
        (one,), answer = results.conditions[0].comparisons, results.reading[0]
        assert answer.verdict.startswith(verdict)
        assert f"{one.ratio:.3f} times that with A" in answer.sentences[0]
        assert ("better" in text_of(results)) == ("better" in verdict)
        assert "nan" not in text_of(results)
        summary = summary_of(results)
        assert summary["line"] == f"{answer.heading} {answer.verdict}"
        (ratios,) = summary["ratios"]
        interval = None if one.low is None else [one.low, one.high]
        assert (ratios["condition"], ratios["interval"]) == ("plain", interval)
        page = study_page(results).decode()
        assert ("± –" in page) == ("repetitions" in made) and "± 0<" not in page

    def test_it_names_the_conditions_where_they_differ(self) -> None:
        turned = study(condition(0.8), condition(1.25, named=EFFECTS))
        verdicts = {one.key: one.verdict for one in turned.reading}
        assert verdicts["prediction"].startswith("Without unmodelled effects: B is better")
        assert "With unmodelled effects: A is better" in verdicts["prediction"]
        assert verdicts["effects"].startswith("Yes: A is better")
        same = study(condition(0.8), condition(0.8, named=EFFECTS))
        verdicts = {one.key: one.verdict for one in same.reading}
        assert verdicts["effects"] == "No." and verdicts["prediction"].startswith("B is better")

    @pytest.mark.parametrize(("ratio", "gone"), [(1.0, True), (1.25, False)])
    def test_more_motion_alone_is_not_a_better_method(self, ratio: float, gone: bool) -> None:
        """A's motion is the longer one; `ratio` is that of B over as much motion of A."""
        cut = condition(ratio, scatter=0.3 if gone else 0.05).comparisons
        equal = EqualDataResult(
            cut="a", name="a-equal", repetitions=2, seconds=40.0, other="b", other_seconds=38.0,
            comparisons=[one.model_copy(update={"first": "a-equal"}) for one in cut],
        )  # fmt: skip
        uneven = condition(1.25).model_copy(update={"equal_data": equal})
        verdict = study(uneven).reading[0].verdict
        assert verdict.startswith("A is better")
        assert ("% smaller, but not with as much motion of each." in verdict) is gone


class TestPlans:
    """What is searched and run."""

    def test_the_best_sines_are_those_of_largest_determinant(self) -> None:
        def found(**log10_det: float) -> dict[str, Search]:
            motions = {
                key.replace("_", "-"): SimpleNamespace(criteria=SimpleNamespace(log10_det=one))
                for key, one in log10_det.items()
            }
            searches = {key: SimpleNamespace(excitation=one) for key, one in motions.items()}
            return cast(dict[str, Search], searches)

        both = found(a_middle=60.0, a_home=65.0, a_middle_fast=80.0, b=90.0)
        assert best_sines(both) == "a-middle-fast"
        assert best_sines(both, PRINTED_SINES) == "a-home"
        assert best_sines(found(b=90.0)) is None

    def test_ended_campaigns_are_left_out(self, tmp_path: Path) -> None:
        def at(condition: str, key: str) -> Execution:
            return cast(Execution, SimpleNamespace(root=tmp_path / condition / key))

        keys = {"plain": (B, AP), "ablation": (B, "b-fly-0")}
        executions = {name: {key: at(name, key) for key in own} for name, own in keys.items()}
        plans = Plans({}, executions, [])
        left = plans.without({tmp_path / "ablation" / "b-fly-0": "joint 2: drive fault"})
        assert left.executions["ablation"].keys() == {B}
        assert left.missing == ["b-fly-0 could not be run: joint 2: drive fault"]
        left = plans.without({tmp_path / "plain" / AP: "drive fault"})
        assert left.executions["plain"].keys() == {B}
        for name in keys:
            with pytest.raises(StudyError, match=rf"{name}/b: the controller ended .* drive fault"):
                plans.without({tmp_path / name / B: "drive fault"})

    def test_an_error_in_a_child_is_one_sentence(self, tmp_path: Path) -> None:
        calls = [(tmp_path, (tmp_path / "none.toml",))]
        with LocalWorkers(2) as workers, pytest.raises(StudyError, match=r"none\.toml.*resume"):
            in_children(Cell.load, calls, "loading", Silent(), workers)


# A whole study on an arm of two joints


@pytest.fixture(scope="module")
def small() -> StudySettings:
    few = Effort(population=8, generations=1)
    update = {"effort_a": few, "effort_b": few, "fly": (0.0, 0.5), "n_via": (6,)}
    update |= {"coupling_weight": (0.3,), "subsets": (1, 2), "noise": (1.0,)}
    settings = study_settings(quick=True, repetitions=2, motions=3, effects=False)
    return settings.model_copy(update=update)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return fast_cell(tmp_path_factory.mktemp("arm"), standstill_s=0.1)


@pytest.fixture(scope="module", autouse=True)
def short_sines() -> Iterator[None]:
    """Sines of 6 s instead of 20: the simulation of sines is what takes longest."""
    with pytest.MonkeyPatch.context() as patch:
        words, choices = SINES["a-middle-fast"]
        for key in list(SINES):
            patch.delitem(SINES, key)
        patch.setitem(SINES, "a-middle-fast", (words, choices | {"length": 6.0, "ramp": 1.0}))
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, small: StudySettings, arm: Cell) -> Whole:
    """A study that Ctrl-C ended after its first campaign, and that was then started again."""
    root = tmp_path_factory.mktemp("first") / "study"

    def one_and_ctrl_c(executions: Sequence[Execution], *_: object) -> None:
        execute(executions[0])
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hil.study.campaigns.execute_all", one_and_ctrl_c)
        with pytest.raises(KeyboardInterrupt):
            run_study(root, small, Silent(), workers=1, cell=arm)
    assert not (root / "results.json").exists()
    return root, run_study(root, small, Silent(), workers=1, cell=arm)


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take seconds, and some tests do not look at them."""
    monkeypatch.setattr("hil.study.page.study_page", lambda _: b"")


class TestWhole:
    """Searches, campaigns, estimates, tables and page."""

    @pytest.mark.slow
    def test_it_writes_results_and_one_self_contained_page(self, whole: Whole) -> None:
        root, found = whole
        assert StudyResults.load(root / "results.json") == found
        page = (root / "report.html").read_text("utf-8")
        for part in ("Fig. 1", "Fig. 2", "Fig. 3", "Fig. 4", "Table 1", "Table 2"):
            assert f"paper, {part}" in page
        assert_stands_alone(page)
        assert "SIMULATED ARM" in page
        assert all(paragraph.sentences for paragraph in found.reading)

    @pytest.mark.slow
    @pytest.mark.usefixtures("no_page")
    def test_one_seed_is_one_study_however_interrupted(
        self, whole: Whole, small: StudySettings, arm: Cell, tmp_path: Path
    ) -> None:
        """With any number of processes; of searches that is tested where they are."""
        root, found = whole
        again = tmp_path / "study"
        shutil.copytree(root / "designs", again / "designs")
        shutil.copy(root / "study.json", again)
        straight = run_study(again, small, Silent(), workers=2, cell=arm)
        not_the_same: dict[str, object] = {"times": {}, "software": {}}
        texts = [one.model_copy(update=not_the_same).to_json() for one in (found, straight)]
        assert texts[0] == texts[1]

    def test_every_estimate_predicts_every_class(self, whole: Whole) -> None:
        _, found = whole
        (plain,) = found.conditions
        methods = {"a", "b", "b0"}
        methods |= {plain.equal_data.name} if plain.equal_data is not None else set()
        assert len(plain.comparisons) == 9
        classes = [one.motion_class for one in plain.classes]
        assert classes == ["fly-by", "stop-to-stop", "sinusoid"]
        for one in plain.classes:
            assert len(one.archives) == 3
            assert set(one.overall) == set(one.all_rows) == methods | {"planted"}
            assert set(one.own) == methods
        names = ["sines", "fly", "n_via", "weight", "repetitions", "noise"]
        assert [one.key for one in found.ablations] == names
        assert all(point.own for one in found.ablations for point in one.points)
        # Estimates of a rigid arm are near the planted values.
        truth = np.array([one.truth for one in found.parameters])
        for method in found.conditions[0].methods:
            assert not method.undetermined
            distance = np.abs(np.array(method.pooled) - truth)
            assert np.mean(distance <= 4.0 * np.array(method.pooled_std)) >= 0.8, method.key

    def test_held_out_motions_are_of_their_class(self, whole: Whole) -> None:
        for key in ("a", "b", "b0"):
            folder = CampaignFolder(whole[0] / "campaigns" / "plain" / key)
            archives = [open_archive(path) for path in folder.completed("validation")]
            moves = [moves_from_dict(archive.table("plan.json")) for archive in archives]
            assert len(moves) == 3
            flies = {one and any(m.fly.percent > 0.0 for m in one.moves[:-1]) for one in moves}
            assert flies == {{"a": None, "b": True, "b0": False}[key]}

    @pytest.mark.usefixtures("no_page")
    def test_a_restart_repeats_nothing_complete(
        self, whole: Whole, small: StudySettings, arm: Cell, tmp_path: Path
    ) -> None:
        root, found = whole
        copy = shutil.copytree(root, tmp_path / "copy")
        patterns = ("designs/*/excitation.toml", "campaigns/*/*/archives/*.mcap", "fits/*/*.json")

        def written() -> dict[Path, int]:
            return {p: p.stat().st_mtime_ns for one in patterns for p in copy.glob(one)}

        before = written()
        assert len(before) > 30
        lost = copy / "campaigns" / "plain" / "b" / "archives" / "excitation_001_a1.mcap"
        lost.unlink()  # as if it had never been written whole
        again = run_study(copy, small, Silent(), workers=1, cell=arm)
        new = {path for path, when in written().items() if when != before.get(path)}
        assert {path.parent.parent.name for path in new if path.suffix == ".mcap"} == {"b"}
        assert not any(path.name == "excitation.toml" for path in new)
        fits = {path.stem for path in new if path.parent.parent.name == "fits"}
        # What rests on the lost repetition is estimated and predicted with again, and nothing else.
        assert fits == {"b", "a-sinusoid", "b-fly-by", "b0-stop-to-stop"}
        methods = zip(again.conditions[0].methods, found.conditions[0].methods, strict=True)
        assert [now.mean == then.mean for now, then in methods] == [True, False, True]

    @pytest.mark.slow
    @pytest.mark.usefixtures("no_page")
    def test_unmodelled_effects_are_another_condition(
        self, whole: Whole, small: StudySettings, arm: Cell, tmp_path: Path
    ) -> None:
        again = tmp_path / "study"
        shutil.copytree(whole[0] / "designs", again / "designs")
        begun = StudySettings.model_validate_json((whole[0] / "study.json").read_text())
        some = small.model_copy(update={"effects": True, "repetitions": 4, "cell": begun.cell})
        (again / "study.json").write_text(some.to_json())
        plain, effects = run_study(again, some, Silent(), workers=2, cell=arm).conditions
        assert (plain.key, effects.key) == ("plain", "effects")
        assert effects.effects and not effects.own_comparisons
        assert all(one.repetitions == [4, 4] for one in effects.comparisons)
        assert "too few" not in {one.verdict for one in effects.comparisons}
        medians = [np.median(some.classes[0].overall["b"]) for some in (plain, effects)]
        assert medians[1] > medians[0]

    def test_other_settings_are_refused_in_the_same_folder(
        self, whole: Whole, small: StudySettings, arm: Cell
    ) -> None:
        root, _ = whole
        with pytest.raises(
            InputError, match="seed: the study in this folder was started with 1, no"
        ):
            run_study(root, small.model_copy(update={"seed": 2}), Silent(), workers=1, cell=arm)
        with pytest.raises(InputError, match="is not empty and contains no study"):
            run_study(root / "fits", small, Silent(), workers=1, cell=arm)


class TestCommand:
    """`hil study`."""

    def test_ctrl_c_gives_one_sentence_and_exit_status(
        self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
    ) -> None:
        def interrupted(*_: object, **__: object) -> None:
            raise KeyboardInterrupt

        monkeypatch.setattr("hil.cli.study.run_study", interrupted)
        ended = CliRunner().invoke(app, ["study", "--quick", "-o", str(tmp_path)])
        assert isinstance(ended.exception, OperatorStopError)
        assert ended.exception.exit_code == 130
        assert f"the same command resumes the study in {tmp_path}" in str(ended.exception)
