"""The paper's study: errors, comparison, criteria, conclusion, and a whole one on a small arm."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from hil.base.errors import InputError
from hil.base.interrupt import descendants
from hil.base.progress import Silent
from hil.cell import Cell
from hil.control.planted_arm import planted_values
from hil.design.messages import NoExcitationError
from hil.study import (
    FULL_STUDY,
    QUICK_STUDY,
    StudyResults,
    StudySettings,
    run_study,
    study_settings,
)
from hil.study.campaigns import MOTION_CLASSES, StudyExecution, execute
from hil.study.criteria_relations import relations_of
from hil.study.estimates import HeldOutForms
from hil.study.method_comparison import MIN_UNITS, compared, verdict_of
from hil.study.model_errors import ALL, NONE, Condition
from hil.study.paper_figures import parameters_of
from hil.study.results import Criterion, DesignPoint
from hil.study.searches import SINES, search_plans, take_best
from hil.study.settings import Effort
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_cell
from tests.hil.report.pages import assert_stands_alone

pytestmark = pytest.mark.long

Array = NDArray[np.float64]
Whole = tuple[Path, StudyResults]


def random_forms(motions: int, n: int) -> Array:
    """Motions with torque that parameters (n,) of 0 predict exactly."""
    random = np.random.default_rng(0)
    tables = random.standard_normal((motions, 40, n)) * random.uniform(1, 3, (motions, 1, 1))
    return np.array([np.pad(table.T @ table, (0, 1)) for table in tables])


def errors(forms: Array, estimates: Array) -> Array:
    """Errors (s, m) of the estimates (s, p) of searches."""
    return np.stack([HeldOutForms("", forms[None]).errors(one[None])[0] for one in estimates])


def test_a_form_gives_the_error_of_an_estimate() -> None:
    random = np.random.default_rng(1)
    phi, tau, values = (random.standard_normal(shape) for shape in ((50, 3), 50, (4, 3)))
    table = np.column_stack([phi, tau])
    found = errors((table.T @ table / (tau @ tau))[None], values)
    expected = np.linalg.norm(tau - values @ phi.T, axis=1) / np.linalg.norm(tau)
    np.testing.assert_allclose(found, expected[:, None])


def test_true_values_in_printed_units_are_the_manufacturers() -> None:
    cell = Cell.load(CELL_PATH)
    printed = [
        parameter for parameter in parameters_of(cell, planted_values(cell)) if parameter.printed_id
    ]
    with_figure = [parameter for parameter in printed if parameter.printed_c is not None]
    assert len(printed) == 58 and len(with_figure) == 52
    for parameter in with_figure:
        assert parameter.printed_factor * parameter.truth == pytest.approx(
            parameter.printed_c, abs=6e-4
        ), parameter


class TestCompared:
    """Ratios of errors, with what other searches, repetitions and motions would have changed."""

    def test_equal_searches_leave_the_scatter_of_motions(self) -> None:
        logs = np.random.default_rng(3).normal(0.1, 0.3, 12)
        forms = np.zeros((12, 3, 3))
        forms[:, 0, 0], forms[:, 1, 1] = 1.0, np.exp(2.0 * logs)
        first = np.tile([1.0, 0.0], (13, 1))
        second = np.tile([0.0, 1.0], (13, 1))
        found = compared(errors(forms, first), errors(forms, second))
        assert found.ratio == pytest.approx(np.exp(logs.mean()))
        assert (found.wins, found.motion_count) == (np.count_nonzero(logs < 0.0), 12)
        assert found.high is not None
        width = np.log(found.high / found.ratio)
        # A standard deviation of 2000 draws is known to about 2 %.
        assert width == pytest.approx(stats.sem(logs) * stats.t.ppf(0.975, 11), rel=0.06)

    def test_luck_of_searches_does_not_vanish_with_more_motions(self) -> None:
        random = np.random.default_rng(2)
        values = [np.eye(6)[k] + 0.2 * random.standard_normal((5, 6)) for k in (0, 1)]
        widths = []
        for motions in (10, 160):
            forms = random_forms(motions, 6)
            found = compared(*(errors(forms, one) for one in values))
            assert found.low is not None and found.high is not None
            widths.append(np.log(found.high / found.low))
        assert widths[1] > 0.5 * widths[0]  # over motions alone it would fall to a quarter

    @pytest.mark.parametrize("searches", [3, 10, 30])
    def test_a_method_seldom_differs_from_itself(self, searches: int) -> None:
        trials = 60
        differ = 0
        random = np.random.default_rng(4)
        forms = random_forms(10, 12)
        for _ in range(trials):
            luck = random.standard_normal((2, searches, 12))
            found = compared(*(errors(forms, one) for one in 3.0 + luck))
            differ += found.verdict not in ("none", "too few")
        # At 5 %, or less, so many are exceeded once in 1000 times.
        assert differ <= stats.binom(trials, 0.05).ppf(0.999)

    def test_a_difference_that_exists_is_found(self) -> None:
        forms = random_forms(10, 12)
        random = np.random.default_rng(5)
        near, far = (
            errors(forms, off + 0.02 * random.standard_normal((10, 12))) for off in (1.0, 1.2)
        )
        found = compared(near, far)
        assert found.ratio == pytest.approx(1.2, rel=0.02)
        assert found.low is not None and found.low > 1.15
        assert found.verdict == "worse"
        assert compared(far, near).verdict == "better"

    @pytest.mark.parametrize(("searches", "motions"), [(MIN_UNITS - 1, 10), (5, 1)])
    def test_too_few_searches_or_motions(self, searches: int, motions: int) -> None:
        values = np.random.default_rng(6).standard_normal((2, searches, 4))
        found = compared(*(errors(random_forms(motions, 4), one) for one in values))
        assert (found.verdict, found.low, found.high) == ("too few", None, None)

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
    def test_the_verdict_is_that_of_the_interval(
        self, ratio: float, low: float | None, high: float | None, verdict: str
    ) -> None:
        assert verdict_of(ratio, low, high) == verdict


class TestRelations:
    """Rank correlations of criteria, over all designs and among the designs of one method."""

    @staticmethod
    def of(x: Array, error: Array) -> Any:
        """The relation of a coupling index with an error, of two methods with half each."""
        methods: Any = ["a"] * (len(x) // 2) + ["b"] * (len(x) - len(x) // 2)
        points = [
            DesignPoint(
                key=f"{k}",
                method=method,
                criteria=dict.fromkeys(get_args(Criterion), float(x[k])),
                variance=1.0,
                bias={},
                error={NONE.key: float(error[k])},
            )
            for k, method in enumerate(methods)
        ]
        found = relations_of(points, [NONE])
        return next(row for row in found if row.quantity == "error")

    def test_a_monotone_relation_has_one_everywhere(self) -> None:
        x = np.random.default_rng(1).permutation(20) + 1.0
        row = self.of(x, x**3)
        assert (row.correlation, row.low, row.high, row.within) == pytest.approx((1, 1, 1, 1))

    def test_methods_that_differ_are_no_relation_within_one(self) -> None:
        place = np.tile(np.arange(20.0), 2)
        method = np.repeat([1.0, 101.0], 20)
        row = self.of(method + place, method + np.abs(place - 9.5))
        assert row.correlation > 0.6 and row.low > 0.5
        assert row.within == pytest.approx(0.0, abs=1e-12)
        assert row.within_low < 0.0 < row.within_high

    def test_it_is_spearmans(self) -> None:
        x, y = np.random.default_rng(3).random((2, 15)) + 1.0
        assert self.of(x, y).correlation == pytest.approx(stats.spearmanr(x, y).statistic)


class TestSearches:
    """Every method has the same duration, limits and number of searches."""

    def test_ten_searches_of_each_method_have_one_duration(self) -> None:
        plans = search_plans(FULL_STUDY, 6)
        assert [plan.method for plan in plans] == ["a"] * 10 + ["b"] * 10 + ["gradient"] * 10
        assert len({(plan.method, plan.choices[0].settings.seed) for plan in plans}) == 30
        for plan in plans:
            for choice in plan.choices:
                settings = choice.settings
                constraints = settings.constraints
                assert (constraints.collision, constraints.current) == (True, True)
                if settings.sines is None:
                    assert constraints.max_duration == 16.0
                    assert constraints.min_duration == pytest.approx(0.97 * 16.0)
                else:
                    assert settings.sines.length == 16.0

    def test_open_choices_share_an_effort_that_is_alike(self) -> None:
        plans = {plan.method: plan for plan in search_plans(FULL_STUDY, 6)}
        tried = {
            method: sum(
                choice.settings.search.population * choice.settings.search.generations
                for choice in plans[method].choices
            )
            for method in ("a", "b")
        }
        assert tried["a"] == tried["b"]
        assert len(plans["a"].choices) == len(SINES)
        assert (
            len(search_plans(FULL_STUDY, 7)[0].choices) == 2
        )  # printed frequencies are of six joints

    @pytest.mark.parametrize(("method", "best"), [("a", "det"), ("b", "fit")])
    def test_a_method_takes_the_best_by_its_own_criterion(self, method: Any, best: str) -> None:
        plan: Any = SimpleNamespace(key="k", method=method, choices=())
        found: Any = [
            (
                SimpleNamespace(words=words),
                SimpleNamespace(
                    settings=None,
                    excitation=SimpleNamespace(
                        tried=8,
                        criteria=SimpleNamespace(log10_det=log10_det, fitness=fitness),
                    ),
                ),
            )
            for words, log10_det, fitness in (("det", 80.0, 50.0), ("fit", 70.0, 60.0))
        ]
        assert take_best(plan, found).choice == best
        assert take_best(plan, found).tried == 16
        with pytest.raises(NoExcitationError, match="search k found no motion"):
            take_best(plan, [])


# A whole study on an arm of two joints


@pytest.fixture(scope="module")
def small() -> StudySettings:
    few = Effort(population=8, generations=2)
    changes: dict[str, Any] = {"effort_a": few, "effort_b": few, "effort_gradient": few}
    # A search of some motions through via points does not find one of a given duration.
    settings = study_settings(quick=True, motions=6, duration=4.0, shortest=0.1)
    return settings.model_copy(update={**changes, "gradient_steps": 2})


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return fast_cell(tmp_path_factory.mktemp("arm"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, small: StudySettings, arm: Cell) -> Whole:
    """A study that Ctrl-C ended after its first campaign, and that was then started again."""
    root = tmp_path_factory.mktemp("first") / "study"
    in_children = "hil.study.study.in_children"

    def one_and_ctrl_c(
        _: object, calls: Sequence[tuple[Path, tuple[StudyExecution]]], *__: Any
    ) -> None:
        execute(*calls[0][1])
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(in_children, one_and_ctrl_c)
        with pytest.raises(KeyboardInterrupt):
            run_study(root, small, Silent(), workers=1, cell=arm)
    assert not (root / "results.json").exists()
    return root, run_study(root, small, Silent(), workers=1, cell=arm)


class TestWhole:
    """Searches, campaigns, estimates, tables and page."""

    def test_it_writes_results_and_one_self_contained_page(self, whole: Whole) -> None:
        root, results = whole
        assert StudyResults.load(root / "results.json") == results
        page = (root / "report.html").read_text("utf-8")
        for part in ("Fig. 1", "Fig. 2", "Fig. 3", "Fig. 4", "Table 1", "Table 2"):
            assert f"paper, {part}" in page
        assert_stands_alone(page)
        assert "SIMULATED ARM" in page and "nan" not in " ".join(results.conclusion)
        assert all(sentence in page for sentence in results.conclusion)

    def test_the_conclusion_has_ten_lines_that_fit_a_screen(self, whole: Whole) -> None:
        _, results = whole
        assert len(results.conclusion) <= 10
        assert max(map(len, results.conclusion)) <= 100

    def test_each_error_is_a_condition_at_two_sizes(self, whole: Whole) -> None:
        """The small arm has no ripple, rigid gears and no delay."""
        _, results = whole
        errors = ("friction drift", "Stribeck friction", "friction with load")
        errors += ("link lengths", "torque constants")
        expected = [NONE, *(Condition(name, k) for name in errors for k in (1, 2)), ALL]
        assert [row.key for row in results.conditions] == [row.key for row in expected]
        for condition in results.conditions:
            for motions in MOTION_CLASSES:
                assert condition.comparison("a", "b", motions).motion_count == 3
                assert condition.comparison("a", "b", motions, printed_sizes=True).ratio > 0.0

    def test_without_errors_estimates_are_near_the_truth(self, whole: Whole) -> None:
        _, results = whole
        truth = np.array([parameter.truth for parameter in results.parameters])
        for method in results.shown[0].methods:
            assert not method.undetermined
            distance = np.abs(np.array(method.pooled) - truth)
            assert np.mean(distance <= 4.0 * np.array(method.pooled_std)) >= 0.8, method.key

    def test_errors_of_the_model_enlarge_bias_and_torque_error(self, whole: Whole) -> None:
        _, results = whole
        for point in results.designs:
            assert point.error[ALL.key] > point.error[NONE.key]
            for error in ("friction-with-load", "torque-constants", "Stribeck-friction"):
                assert point.bias[f"{error}-x2"] > 1.5 * point.bias[f"{error}-x1"]

    @pytest.mark.slow
    def test_one_seed_is_one_study_with_any_number_of_processes(
        self, whole: Whole, small: StudySettings, arm: Cell, tmp_path: Path
    ) -> None:
        """Of searches that is tested where they are."""
        root, results = whole
        again = tmp_path / "study"
        shutil.copytree(root / "designs", again / "designs")
        shutil.copy(root / "study.json", again)
        straight = run_study(again, small, Silent(), workers=2, cell=arm)
        not_the_same: dict[str, object] = {"software": {}}
        texts = [
            study_results.model_copy(update=not_the_same).to_json()
            for study_results in (results, straight)
        ]
        assert texts[0] == texts[1]

    def test_a_restart_repeats_nothing_complete(
        self, whole: Whole, small: StudySettings, arm: Cell, tmp_path: Path
    ) -> None:
        root, results = whole
        copy = shutil.copytree(root, tmp_path / "copy")
        patterns = ("designs/*/*/excitation.toml", "campaigns/*/archives/*.mcap")

        def written() -> dict[Path, int]:
            return {p: p.stat().st_mtime_ns for pattern in patterns for p in copy.glob(pattern)}

        before = written()
        assert len(before) > 25
        lost = copy / "campaigns" / "a-00" / "archives" / "excitation_001_a1.mcap"
        lost.unlink()  # as if it had never been written whole
        again = run_study(copy, small, Silent(), workers=1, cell=arm)
        new = {path for path, when in written().items() if when != before.get(path)}
        assert new and {path.parents[1] for path in new} == {lost.parents[1]}
        same = [
            now.error == then.error
            for now, then in zip(again.designs, results.designs, strict=True)
        ]
        assert same == [False, *[True] * 8]

    def test_other_settings_are_refused_in_the_same_folder(
        self, whole: Whole, small: StudySettings, arm: Cell
    ) -> None:
        root, _ = whole
        with pytest.raises(InputError, match="seed: the study in this folder was started with 1"):
            run_study(root, small.model_copy(update={"seed": 2}), Silent(), workers=1, cell=arm)
        with pytest.raises(InputError, match="is not empty and contains no study"):
            run_study(root / "designs", small, Silent(), workers=1, cell=arm)


@pytest.mark.parametrize("request_to_end", [signal.SIGINT, signal.SIGTERM])
def test_a_study_in_the_background_ends_within_a_second(
    tmp_path: Path, request_to_end: signal.Signals
) -> None:
    """A shell without job control starts programs in the background with SIGINT ignored."""
    output = tmp_path / "study"
    command = f"nohup {sys.executable} -m hil study --quick -o {output} > {tmp_path}/log 2>&1 & "
    shell = ["sh", "-c", command + "echo $!; wait $!; echo $?"]
    with subprocess.Popen(shell, stdout=subprocess.PIPE, text=True) as started:
        assert started.stdout is not None
        pid = int(started.stdout.readline())
        try:
            patience = time.monotonic() + 300.0
            while not list(output.glob("designs/*/*/search.journal")):
                assert time.monotonic() < patience, (tmp_path / "log").read_text()
                time.sleep(0.1)
            children = descendants(pid)
            assert len(children) >= 2  # workers, and the planners of their searches
            began = time.monotonic()
            os.kill(pid, request_to_end)
            status = int(started.stdout.readline())
            while any(Path(f"/proc/{child}").exists() for child in children):
                time.sleep(0.01)
            lasted = time.monotonic() - began
        finally:
            for one in [pid, *descendants(pid)]:
                if Path(f"/proc/{one}").exists():
                    os.kill(one, signal.SIGKILL)
    assert status == 128 + request_to_end
    assert "the same command resumes the study" in (tmp_path / "log").read_text()
    # A second, where the processes of others leave this one a core.
    assert lasted < max(1.0, os.getloadavg()[0] / len(os.sched_getaffinity(0)))


def test_the_quick_study_has_fewer_of_everything() -> None:
    smaller = [
        name
        for name in StudySettings.model_fields
        if getattr(QUICK_STUDY, name) != getattr(FULL_STUDY, name)
    ]
    assert set(smaller) == {
        "searches", "motions", "effort_a", "effort_b", "effort_gradient", "gradient_steps"
    }  # fmt: skip
