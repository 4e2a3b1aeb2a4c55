"""The paper's study: errors, comparison, conclusion, and a whole one on a small arm."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats
from typer.testing import CliRunner

from hil.base.errors import InputError, OperatorStopError
from hil.base.progress import Silent
from hil.cell import Cell
from hil.cli import app
from hil.control.simulation import planted_values
from hil.design.messages import NoExcitationError
from hil.study import StudyResults, StudySettings, run_study, study_settings
from hil.study.campaigns import SINES, StudyExecution, chosen, execute
from hil.study.results import (
    MIN_UNITS,
    StudyComparison,
    compared,
    conclusion_of,
    parameters_of,
    relative_errors,
    verdict_of,
)
from hil.study.settings import Effort
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_cell
from tests.hil.test_report import assert_stands_alone

pytestmark = pytest.mark.long

Array = NDArray[np.float64]
Whole = tuple[Path, StudyResults]


def random_forms(motions: int, n: int) -> Array:
    """Motions with torque that parameters (n,) of 0 predict exactly."""
    random = np.random.default_rng(0)
    tables = random.standard_normal((motions, 40, n)) * random.uniform(1, 3, (motions, 1, 1))
    return np.array([np.pad(table.T @ table, (0, 1)) for table in tables])


def test_a_form_gives_the_error_of_an_estimate() -> None:
    random = np.random.default_rng(1)
    phi, tau, values = (random.standard_normal(shape) for shape in ((50, 3), 50, (4, 3)))
    table = np.column_stack([phi, tau])
    errors = relative_errors((table.T @ table / (tau @ tau))[None], values)
    expected = np.linalg.norm(tau - values @ phi.T, axis=1) / np.linalg.norm(tau)
    np.testing.assert_allclose(errors, [expected])


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
    """Ratios of errors, with what other motions and other repetitions would have changed."""

    def test_equal_repetitions_leave_the_scatter_of_motions(self) -> None:
        logs = np.random.default_rng(3).normal(0.1, 0.3, 12)
        forms = np.zeros((12, 3, 3))
        forms[:, 0, 0], forms[:, 1, 1] = 1.0, np.exp(2.0 * logs)
        first = np.tile([1.0, 0.0], (13, 1))
        second = np.tile([0.0, 1.0], (13, 1))
        comparison = compared(forms, first, second)
        assert comparison.ratio == pytest.approx(np.exp(logs.mean()))
        assert (comparison.wins, comparison.motions) == (np.count_nonzero(logs < 0.0), 12)
        width = np.log(comparison.high / comparison.ratio)
        # A standard deviation of 4000 draws is known to about 1 %.
        sizes = stats.sem(logs) * stats.t.ppf(0.975, [5, 11])
        assert 0.95 * sizes[1] < width < 1.05 * sizes[0]

    def test_noise_of_estimates_does_not_vanish_with_more_motions(self) -> None:
        random = np.random.default_rng(2)
        values = [np.eye(6)[k] + 0.2 * random.standard_normal((5, 6)) for k in (0, 1)]
        few, many = (compared(random_forms(m, 6), *values) for m in (10, 160))
        widths = [np.log(comparison.high / comparison.low) for comparison in (few, many)]
        assert widths[1] > 0.5 * widths[0]  # over motions alone it would fall to a quarter

    @pytest.mark.parametrize("repetitions", [3, 10, 30])
    @pytest.mark.parametrize("memory", [0.0, 0.6])
    def test_a_method_seldom_differs_from_itself(self, repetitions: int, memory: float) -> None:
        """Also if successive repetitions are correlated, of which blocks are resampled."""
        trials = 60
        differ = 0
        random = np.random.default_rng(4)
        forms = random_forms(10, 12)
        for _ in range(trials):
            noise = random.standard_normal((2, repetitions, 12))
            for k in range(1, repetitions if repetitions >= 10 else 0):
                noise[:, k] += memory * noise[:, k - 1]
            comparison = compared(forms, *(3.0 + noise))
            differ += comparison.verdict not in ("none", "too few")
        # At 5 %, or less, so many are exceeded once in 1000 times.
        assert differ <= stats.binom(trials, 0.05).ppf(0.999)

    def test_a_difference_that_exists_is_found(self) -> None:
        forms = random_forms(10, 12)
        random = np.random.default_rng(5)
        near, far = (off + 0.02 * random.standard_normal((10, 12)) for off in (1.0, 1.2))
        comparison = compared(forms, near, far)
        assert comparison.ratio == pytest.approx(1.2, rel=0.02)
        assert comparison.low > 1.15
        assert comparison.verdict == "worse"
        assert compared(forms, far, near).verdict == "better"

    @pytest.mark.parametrize(("repetitions", "motions"), [(MIN_UNITS - 1, 10), (1, 10), (5, 1)])
    def test_too_few_repetitions_or_motions(self, repetitions: int, motions: int) -> None:
        values = np.random.default_rng(6).standard_normal((2, repetitions, 4))
        comparison = compared(random_forms(motions, 4), *values)
        assert (comparison.verdict, comparison.low, comparison.high) == ("too few", None, None)

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
        self, ratio: float, low: float | None, high: float | None, verdict: Any
    ) -> None:
        """The conclusion says the same in words, and names the better method."""
        assert verdict_of(ratio, low, high) == verdict
        row = StudyComparison(ratio=ratio, wins=3, motions=9, low=low, high=high, verdict=verdict)
        methods = [SimpleNamespace(values=[[0.0]] * 3, duration=size) for size in (20.0, 8.0)]
        made = SimpleNamespace(words="with effects", comparison=row, methods=methods)
        first, second = conclusion_of([cast(Any, made)], quick=False)
        assert ("better" in first) == ("better" in verdict or "worse" in verdict)
        assert first.startswith("With effects: B is") == ("better" in verdict)
        assert first.startswith("With effects: A is") == ("worse" in verdict)
        assert "60 s" in second and "24 s" in second
        assert "no conclusion" in conclusion_of([cast(Any, made)], quick=True)[-1]


@pytest.mark.parametrize(
    ("log10_det", "best"),
    [
        ({"middle": 60.0, "home": None, "fast": 80.0, "b": 90.0}, {"a": "fast", "b": "b"}),
        ({"middle": None, "b": 90.0}, None),
        ({"middle": 60.0, "b": None}, None),
    ],
)
def test_the_sines_of_largest_determinant_are_chosen(
    log10_det: dict[str, float | None], best: dict[str, str] | None
) -> None:
    searches: list[Any] = [
        SimpleNamespace(
            key=key,
            description=key,
            excitation=size and SimpleNamespace(criteria=SimpleNamespace(log10_det=size)),
        )
        for key, size in log10_det.items()
    ]
    if best is None:
        with pytest.raises(NoExcitationError, match="found no motion"):
            chosen(searches)
    else:
        assert {key: search.key for key, search in chosen(searches).items()} == best


# A whole study on an arm of two joints


@pytest.fixture(scope="module")
def small() -> StudySettings:
    few = Effort(population=8, generations=1)
    settings = study_settings(quick=True, repetitions=4, motions=3)
    return settings.model_copy(update={"effort_a": few, "effort_b": few})


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    return fast_cell(tmp_path_factory.mktemp("arm"), standstill_s=0.1)


@pytest.fixture(scope="module", autouse=True)
def short_sines() -> Iterator[None]:
    """Sines of 6 s instead of 20: the simulation of sines is what takes longest."""
    with pytest.MonkeyPatch.context() as patch:
        description, choices = SINES["a-middle-fast"]
        for key in list(SINES):
            patch.delitem(SINES, key)
        patch.setitem(SINES, "a-middle-fast", (description, choices | {"length": 6.0, "ramp": 1.0}))
        yield


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, small: StudySettings, arm: Cell) -> Whole:
    """A study that Ctrl-C ended after its first campaign, and that was then started again."""
    root = tmp_path_factory.mktemp("first") / "study"

    def one_and_ctrl_c(
        _: object, calls: Sequence[tuple[Path, tuple[StudyExecution]]], *__: Any
    ) -> None:
        execute(*calls[0][1])
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hil.study.campaigns.in_children", one_and_ctrl_c)
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
        assert all(sentence.split(";")[0] in page for sentence in results.conclusion)

    def test_estimates_predict_and_effects_are_another_condition(self, whole: Whole) -> None:
        _, results = whole
        rigid, effects = results.conditions
        assert (rigid.key, effects.key) == ("no-effects", "effects")
        assert effects.effects and "too few" not in {
            condition.comparison.verdict for condition in (effects,)
        }
        for condition in (rigid, effects):
            assert len(condition.held_out.archives) == 3
            assert all(name.startswith("validation") for name in condition.held_out.archives)
            assert (
                set(condition.held_out.overall)
                == set(condition.held_out.all_rows)
                == {"a", "b", "planted"}
            )
            assert all(len(method.values) == 4 for method in condition.methods)
        medians = [np.median(condition.held_out.overall["b"]) for condition in (rigid, effects)]
        assert medians[1] > medians[0]
        # Estimates of a rigid arm are near the true values.
        truth = np.array([parameter.truth for parameter in results.parameters])
        for method in rigid.methods:
            assert not method.undetermined
            distance = np.abs(np.array(method.pooled) - truth)
            assert np.mean(distance <= 4.0 * np.array(method.pooled_std)) >= 0.8, method.key

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
        patterns = ("designs/*/excitation.toml", "campaigns/*/*/archives/*.mcap")

        def written() -> dict[Path, int]:
            return {p: p.stat().st_mtime_ns for pattern in patterns for p in copy.glob(pattern)}

        before = written()
        assert len(before) > 25
        lost = copy / "campaigns" / "no-effects" / "b" / "archives" / "excitation_001_a1.mcap"
        lost.unlink()  # as if it had never been written whole
        again = run_study(copy, small, Silent(), workers=1, cell=arm)
        new = {path for path, when in written().items() if when != before.get(path)}
        assert new and {path.parents[1] for path in new} == {lost.parents[1]}
        methods = zip(again.conditions[0].methods, results.conditions[0].methods, strict=True)
        assert [now.mean == then.mean for now, then in methods] == [True, False]

    def test_other_settings_are_refused_in_the_same_folder(
        self, whole: Whole, small: StudySettings, arm: Cell
    ) -> None:
        root, _ = whole
        with pytest.raises(InputError, match="seed: the study in this folder was started with 1"):
            run_study(root, small.model_copy(update={"seed": 2}), Silent(), workers=1, cell=arm)
        with pytest.raises(InputError, match="is not empty and contains no study"):
            run_study(root / "designs", small, Silent(), workers=1, cell=arm)


def test_ctrl_c_gives_one_sentence_and_exit_status(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hil.cli.study.run_study", interrupted)
    ended = CliRunner().invoke(app, ["study", "--quick", "-o", str(tmp_path)])
    assert isinstance(ended.exception, OperatorStopError)
    assert ended.exception.exit_code == 130
    assert f"the same command resumes the study in {tmp_path}" in str(ended.exception)
