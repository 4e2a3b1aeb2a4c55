"""The study's statistics: what other motions and other repetitions would have changed."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from hil.campaign import Campaign, CampaignPlan
from hil.campaign.quick_design import design
from hil.cell import Cell
from hil.errors import InputError
from hil.progress import Silent
from hil.study.campaigns import Execution, Plans
from hil.study.page import study_page
from hil.study.recorded import homes, recorded_runs
from hil.study.results import (
    AblationBand,
    AblationPoint,
    AblationResult,
    ComparisonResult,
    ConditionResult,
    EqualDataResult,
    StudyParameter,
    StudyResults,
    reading_of,
    summary_of,
)
from hil.study.searches import AP, B0, A, B, Found, printed_sines
from hil.study.statistics import FEWEST, bands_of, compared_on, corrected, spread, verdict_of
from hil.study.tables import Condition, compared_pairs, condition_result
from tests.hil.fast_cell import fast_cell
from tests.hil.study_numbers import fitted, flagged, forms_of, scored

Array = NDArray[np.float64]


def grams(motions: int, n: int, seed: int = 0) -> list[Array]:
    """Grams (n + 1, n + 1) of [Phi | tau] for torque that parameters of 0 predict exactly."""
    random = np.random.default_rng(seed)
    tables = random.standard_normal((motions, 40, n)) * random.uniform(1, 3, (motions, 1, 1))
    return [np.pad(table.T @ table, (0, 1)) for table in tables]


def by_hand(first: Array, second: Array, some: list[Array]) -> float:
    """Mean log ratio of the errors of two estimates (p,)."""
    ratios = [second @ g[:-1, :-1] @ second / (first @ g[:-1, :-1] @ first) for g in some]
    return float(0.5 * np.log(ratios).mean())


# Quadratic forms


def test_a_form_gives_the_error_of_any_estimate_and_of_any_mean_of_estimates() -> None:
    random = np.random.default_rng(1)
    phi, tau = random.standard_normal((50, 3)), random.standard_normal(50)
    table = np.column_stack([phi, tau])
    forms = forms_of([table.T @ table])
    values = random.standard_normal((4, 3))
    left = np.linalg.norm(tau - phi @ values.mean(axis=0))
    # The torque of these made-up motions is 1.
    assert forms.overall(values.mean(axis=0)) == pytest.approx([left])
    assert np.sqrt(forms.torque_kernels(values).mean()) == pytest.approx(left)
    one_joint = np.sqrt(forms.torque_kernels(values, 0).mean())
    assert one_joint == pytest.approx(left / np.sqrt(2.0))
    away = np.linalg.norm(phi @ (values.mean(axis=0) - 1.0))
    assert forms.own(values.mean(axis=0), np.ones(3)) == pytest.approx([away])
    assert np.sqrt(forms.own_kernels(values, np.ones(3)).mean()) == pytest.approx(away)


# Motions and repetitions drawn


def test_with_repetitions_all_alike_the_motions_alone_make_the_spread() -> None:
    random = np.random.default_rng(3)
    logs = random.normal(0.1, 0.3, 12)
    same = np.ones((12, 4, 4))
    found = spread(same, same * np.exp(2.0 * logs)[:, None, None], drifts=False, seed=0)
    assert found is not None
    assert found.freedom == pytest.approx(11.0)
    # A standard deviation of 4000 draws is known to about 1 %.
    assert found.error == pytest.approx(stats.sem(logs), rel=0.05)


def test_what_is_the_noise_of_the_estimates_does_not_vanish_with_more_motions() -> None:
    few, many = (
        spread(
            *(forms_of(grams(motions, 6)).torque_kernels(flagged(k, 6, 5, 0.2)) for k in (0, 1)),
            drifts=False,
            seed=0,
        )
        for motions in (10, 160)
    )
    assert few is not None and many is not None
    assert many.error > 0.5 * few.error  # over motions alone it would fall to a quarter


@pytest.mark.parametrize("repetitions", [3, 10])
@pytest.mark.parametrize("off", [0.0, 3.0])
def test_a_method_beside_itself_is_seldom_told_to_differ(repetitions: int, off: float) -> None:
    trials, level, told = 60, 0.95, 0
    random, some = np.random.default_rng(4), grams(10, 12)
    forms = forms_of(some)
    for trial in range(trials):
        values = [off + random.standard_normal((repetitions, 12)) for _ in range(2)]
        found = spread(*map(forms.torque_kernels, values), drifts=False, seed=trial)
        assert found is not None
        ratio = by_hand(values[0].mean(axis=0), values[1].mean(axis=0), some)
        told += abs(ratio) > found.half_width(level)
    # At 5 %, or less, so many are exceeded once in 1000 times.
    assert told <= stats.binom(trials, 1.0 - level).ppf(0.999)


def test_a_difference_that_is_there_is_told_when_repetitions_tell_it() -> None:
    forms = forms_of(grams(10, 12))
    random = np.random.default_rng(5)
    near, far = (off + 0.02 * random.standard_normal((10, 12)) for off in (1.0, 1.2))
    inner = forms.torque_kernels(near), forms.torque_kernels(far)
    one = compared_on("fly-by", ("a", "b"), inner, drifts=False)
    assert one.ratio == pytest.approx(1.2, rel=0.02)
    assert one.low is not None and one.low > 1.15
    assert (one.verdict, one.repetitions) == ("worse", [10, 10])
    back = compared_on("fly-by", ("b", "a"), inner[::-1], drifts=False)
    assert back.verdict == "better"
    zero = np.zeros(12)
    own_errors = forms.own_kernels(near, zero), forms.own_kernels(far, zero)
    own = compared_on("fly-by", ("a", "b"), own_errors, drifts=False)
    assert own.ratio == pytest.approx(one.ratio)  # these torques are those of parameters of 0


def test_repetitions_like_their_neighbours_are_drawn_in_blocks() -> None:
    forms = forms_of(grams(10, 4))
    random = np.random.default_rng(6)
    slow = np.repeat(random.standard_normal((9, 4)), 3, axis=0)
    other = 1.0 + random.standard_normal((27, 4))
    inner = forms.torque_kernels(1.0 + slow), forms.torque_kernels(other)
    single, blocks = (spread(*inner, drifts=drifts, seed=0) for drifts in (False, True))
    assert single is not None and blocks is not None
    assert blocks.error > 1.1 * single.error
    assert blocks.freedom < single.freedom


@pytest.mark.parametrize(("repetitions", "motions"), [(FEWEST - 1, 10), (1, 10), (5, 1)])
def test_too_few_repetitions_or_motions_tell_nothing(repetitions: int, motions: int) -> None:
    forms = forms_of(grams(motions, 4))
    a, b = (forms.torque_kernels(flagged(k, 4, repetitions, 0.01)) for k in range(2))
    one = compared_on("fly-by", ("a", "b"), (a, b), drifts=False)
    assert (one.verdict, one.low, one.high, one.error) == ("too few", None, None, None)
    assert not one.differs


# Verdicts


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
    ratio: float, low: float | None, high: float | None, verdict: str
) -> None:
    assert verdict_of(ratio, low, high) == verdict


def compared(ratio: float, error: float) -> ComparisonResult:
    return ComparisonResult(
        motion_class="fly-by", joint=None, first="a", second="b", motions=10, repetitions=[5, 5],
        ratio=ratio, error=error, freedom=8.0, level=0.95, low=None, high=None, verdict="none",
        wins=5, p_value=0.01, p_corrected=0.01,
    )  # fmt: skip


def test_in_a_larger_table_intervals_are_wider_and_verdicts_follow_them() -> None:
    error = 0.1 / stats.t.ppf(0.985, 8.0)  # leaves out 1 at 97 %
    (alone,) = corrected([compared(np.exp(0.1), error)])
    among = corrected([compared(np.exp(0.1), error)] * 4)
    assert (alone.level, alone.verdict) == (0.95, "worse")
    assert (among[0].level, among[0].verdict) == (0.9875, "none")
    assert alone.low is not None and alone.low > 1.0
    assert among[0].low is not None and among[0].low < 1.0
    assert [one.p_corrected for one in among] == pytest.approx([0.04] * 4)


def test_the_printed_sines_are_set_beside_b_alone() -> None:
    assert compared_pairs([A, B, B0]) == [(A, B), (A, B0), (B, B0)]
    assert compared_pairs([A, B, B0, AP]) == [(A, B), (A, B0), (B, B0), (AP, B)]


# Ablations


def test_the_band_holds_what_other_repetitions_of_one_motion_give() -> None:
    forms, values = forms_of(grams(5, 4)), flagged(0, 4, 6, 0.1)
    found = bands_of("b", values, 1, {"fly-by": forms}, np.zeros(4), values[0])
    bands = {one.quantity: one for one in found}
    singles = [float(np.median(forms.overall(one))) for one in values]
    assert (bands["error"].low, bands["error"].high) == pytest.approx((min(singles), max(singles)))
    assert bands["error"].subsets == 6
    assert bands["own"].low == pytest.approx(bands["error"].low)
    assert bands["parameter_error"].low <= 1.0 <= bands["parameter_error"].high
    assert bands_of("b", values, 6, {"fly-by": forms}, np.zeros(4), values[0]) == []
    assert {one.quantity for one in bands_of("b", values, 3, {"x": forms}, None, values[0])} == {
        "error"
    }


def found(**log10_det: float) -> dict[str, Found]:
    """Searches of method A with what they found; names with underscores."""
    return {
        key.replace("_", "-"): cast(
            Found,
            SimpleNamespace(excitation=SimpleNamespace(criteria=SimpleNamespace(log10_det=d))),
        )
        for key, d in log10_det.items()
    }


def test_the_papers_own_sines_are_a_method_where_they_are_not_the_best() -> None:
    both = {"a_middle": 60.0, "a_home": 65.0}
    assert printed_sines(found(**both, a_middle_fast=80.0)) == "a-home"
    assert printed_sines(found(**both, a_middle_fast=62.0)) is None
    assert printed_sines(found(a_home_fast=62.0)) is None  # another arm has no print


def test_an_arm_that_does_not_bear_the_papers_sines_still_has_a_study(tmp_path: Path) -> None:
    one = cast(Execution, SimpleNamespace(root=tmp_path / AP))
    plans = Plans("a-middle-fast", "a-home", {}, {"plain": {AP: one}}, [])
    left = plans.without({one.root: "joint 2: drive fault"})
    assert left.executions == {"plain": {}}
    assert left.missing == ["a-printed could not be run: joint 2: drive fault"]


PLAIN = Condition("plain", "the arm is what the model says", (), drifts=False)
EFFECTS = Condition("effects", "the arm does what the model leaves out", ("ripple",), drifts=False)
PARAMETERS = [StudyParameter(name=f"p{k}", unit="kg", truth=0.0) for k in range(2)]


def condition(
    ratio: float,
    *,
    named: Condition = PLAIN,
    scatter: float = 0.05,
    motions: int = 30,
    repetitions: int = 5,
    noise: float = 0.01,
    labels: Mapping[str, str] | None = None,
    classes: Sequence[str] = ("fly-by",),
    parameters: Sequence[StudyParameter] = PARAMETERS,
) -> ConditionResult:
    """The second method's errors are so many times the first's, but for scatter over motions."""
    random = np.random.default_rng(5)
    labels = labels or {"a": "A", "b": "B"}
    a = random.uniform(0.01, 0.03, motions)
    b = ratio * a * np.exp(scatter * random.standard_normal(motions))
    return condition_result(
        named,
        labels,
        {key: fitted(flagged(k, 2, repetitions, noise)) for k, key in enumerate(labels)},
        {name: scored(dict(zip(labels, (a, b), strict=True))) for name in classes},
        list(parameters),
        ("hip", "knee"),
    )


def study(*conditions: ConditionResult, ablations: Sequence[AblationResult] = ()) -> StudyResults:
    results = StudyResults(
        name="told", cell="told", simulated=True, quick=False, settings=None, software={},
        joint_names=["hip", "knee"], n_base=2, parameters=PARAMETERS, searches=[], table1=[],
        conditions=list(conditions), ablations=list(ablations), reading=[], missing=[], times={},
    )  # fmt: skip
    return results.model_copy(update={"reading": reading_of(results)})


def text_of(results: StudyResults) -> str:
    return " ".join(text for one in results.reading for text in (one.verdict, *one.sentences))


class TestConclusion:
    @pytest.mark.parametrize(("ratio", "winner", "loser"), [(0.8, "B", "A"), (1.25, "A", "B")])
    def test_a_clear_difference_has_direction_and_size(
        self, ratio: float, winner: str, loser: str
    ) -> None:
        results = study(condition(ratio))
        (one,) = results.conditions[0].comparisons
        answer = results.reading[0]
        assert one.low is not None and one.high is not None
        saved = 100.0 * (1.0 - min(one.ratio, 1.0 / one.ratio))
        assert answer.verdict == f"{winner} is better, its error {saved:.0f} % smaller."
        assert f"{one.ratio:.3f} times" in answer.sentences[0]
        assert f"(interval {one.low:.3f} to {one.high:.3f})" in answer.sentences[0]
        assert f"{loser} is better" not in text_of(results)
        assert summary_of(results)["line"] == f"{answer.heading} {answer.verdict}"
        (ratios,) = summary_of(results)["ratios"]
        assert (ratios["condition"], ratios["interval"]) == ("plain", [one.low, one.high])

    def test_what_may_be_chance_is_never_better(self) -> None:
        results = study(condition(1.0, scatter=0.3))
        assert results.reading[0].verdict == "No significant difference."
        assert "better" not in text_of(results)
        assert not summary_of(results)["ratios"][0]["differs"]

    def test_a_small_difference_is_slight(self) -> None:
        slight = study(condition(0.99, scatter=0.002, noise=1e-3))
        assert "B is slightly better" in summary_of(slight)["line"]
        assert "slightly" not in summary_of(study(condition(0.8)))["line"]

    def test_it_names_the_conditions_where_they_differ(self) -> None:
        turned = study(condition(0.8), condition(1.25, named=EFFECTS))
        verdicts = {one.key: one.verdict for one in turned.reading}
        assert verdicts["prediction"].startswith("Without unmodelled effects B is better")
        assert "; with unmodelled effects A is better" in verdicts["prediction"]
        assert verdicts["effects"].startswith("Yes: A is better")
        same = study(condition(0.8), condition(0.8, named=EFFECTS))
        assert {one.key: one.verdict for one in same.reading}["effects"] == "No."

    @pytest.mark.parametrize(("ratio", "gone"), [(1.0, True), (1.25, False)])
    def test_more_motion_alone_is_no_better_method(self, ratio: float, gone: bool) -> None:
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

    def test_one_repetition_is_too_few_and_has_no_scatter(self) -> None:
        results = study(condition(0.8, repetitions=1))
        assert results.reading[0].verdict.startswith("Too few repetitions or motions")
        assert "nan" not in text_of(results)
        page = study_page(results).decode()
        assert "± –" in page and "± 0<" not in page

    def test_without_held_out_motions_there_is_none(self) -> None:
        results = study(condition(0.8, classes=()))
        assert "no held-out motion" in summary_of(results)["line"]
        study_page(results)

    def test_of_unknown_methods_it_names_neither_a_nor_b(self) -> None:
        printed = [
            one.model_copy(
                update={"printed_id": k + 1, "printed_a": 1.0, "printed_b": 2.0, "printed_c": 0.5}
            )
            for k, one in enumerate(PARAMETERS)
        ]
        labels = {"march": "march", "june": "june"}
        recorded = Condition("recorded", "as recorded", ())
        found = condition(0.8, named=recorded, labels=labels, parameters=printed)
        results = study(found)
        text = text_of(results)
        assert "with june is closer to π_C than that with march" in study_page(results).decode()
        assert re.search(r"\b(than|with|of|and) [AB]\b|\b[AB]'s", text) is None

    def test_campaigns_that_contradict_each_other_are_named(self) -> None:
        homes_ = [
            condition(ratio, named=Condition(f"recorded-{key}", f"on the motions of {key}", ()))
            for key, ratio in (("march", 1.3), ("june", 0.7))
        ]
        answer = study(*homes_).reading[0]
        assert answer.verdict.startswith("On the motions of march A is better")
        assert "on the motions of june B is better" in answer.verdict
        assert "opposite conclusions" in answer.sentences[0]


def test_settings_outside_the_range_of_chance_are_named() -> None:
    def point(value: float, own: float) -> AblationPoint:
        return AblationPoint(
            value=value, method="b", base=value == 0.5, repetitions=3, log10_det=1.0,
            coupling_index=2.0, duration=1.0, parameter_error=1.0, error={"fly-by": 0.01},
            own={"fly-by": own},
        )  # fmt: skip

    band = AblationBand(
        method="b", repetitions=3, quantity="own", motion_class="fly-by", low=1e-3, high=2e-3,
        subsets=400,
    )  # fmt: skip
    fly = AblationResult(
        key="fly", title="Fly-by share", variable="fly-by share", words="Varied.",
        points=[point(0.0, 1.5e-3), point(0.5, 5e-3), point(1.0, 2.5e-3)], bands=[band],
    )  # fmt: skip
    (found,) = (one for one in study(condition(1.0), ablations=[fly]).reading if "fly" in one.key)
    assert any(text.endswith("0.100 % to 0.200 %; outside: 1.") for text in found.sentences)


# Recorded campaigns


@pytest.fixture(scope="module")
def twins(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two campaigns of method B that are called a and b, and run the same held-out motions."""
    root = tmp_path_factory.mktemp("recorded")
    cell = fast_cell(root, repetitions=1)
    plan = design(cell, Silent())
    return [_ran(root / name, cell, plan) for name in ("a", "b")]


def _ran(folder: Path, cell: Cell, plan: CampaignPlan) -> Path:
    Campaign.create(folder, cell, plan).run(unrehearsed=True, durable=False)
    return folder


@pytest.mark.slow
def test_a_folder_of_a_methods_name_makes_no_method(twins: list[Path]) -> None:
    found = recorded_runs(twins)
    assert not {one.run.key for one in found} & {"a", "b", "b0"}
    assert [one.run.label for one in found] == ["a", "b"]
    assert homes([one.run for one in found]) == [one.run for one in found]
    with pytest.raises(InputError, match="named twice"):
        recorded_runs([twins[0], twins[0]])


@pytest.mark.slow
def test_arms_of_other_drives_or_other_effects_are_refused(
    twins: list[Path], tmp_path: Path
) -> None:
    cell = fast_cell(tmp_path, repetitions=1)
    other = cell.text.replace("gear_ratio = [100.0", "gear_ratio = [110.0")
    stranger = Cell.from_texts(other, cell.urdf, cell.path)
    folder = _ran(tmp_path / "stranger", stranger, design(stranger, Silent()))
    with pytest.raises(InputError, match=r"another arm.*\[drive_train\]"):
        recorded_runs([twins[0], folder])
