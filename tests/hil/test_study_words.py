"""What a study says: sentences made from numbers, whatever the numbers are."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from hil.campaign import Campaign, CampaignPlan
from hil.campaign.quick_design import design
from hil.cell import Cell
from hil.errors import InputError
from hil.progress import Silent
from hil.study.page import study_page
from hil.study.recorded import homes, recorded_runs
from hil.study.results import (
    AblationBand,
    AblationPoint,
    AblationResult,
    ConditionResult,
    EqualDataResult,
    StudyParameter,
    StudyResults,
    reading_of,
    summary_of,
)
from hil.study.tables import Condition, condition_result

from .fast_cell import fast_cell
from .study_numbers import fitted, flagged, scored

Array = NDArray[np.float64]

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
