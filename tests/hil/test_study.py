"""The paper's study: statistics, sentences made from numbers, and a whole one on a small arm."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from typer.testing import CliRunner

from hil.archive import open_archive
from hil.campaign import CampaignFolder
from hil.cell import Cell
from hil.cli import app
from hil.errors import InputError, OperatorStopError
from hil.progress import Silent
from hil.simulation import planted_values
from hil.study import StudyResults, StudySettings, run_study, study_campaigns, study_settings
from hil.study.campaigns import (
    Execution,
    StudyError,
    execute,
    plan_study,
    workers_of,
)
from hil.study.records import ClassForms, Run, ScoreRecord, class_of, classes_of
from hil.study.searches import SINES, run_searches, searches
from hil.study.settings import Effort, StudyFolder
from hil.study.statistics import compare, equal_data, parameter_error
from hil.study.tables import estimates_of, parameters_of
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.fast_cell import fast_cell
from tests.hil.study_numbers import fitted
from tests.hil.test_report import assert_stands_alone

Array = NDArray[np.float64]

errors = st.lists(
    st.tuples(st.floats(0.01, 10.0), st.floats(0.01, 10.0)), min_size=1, max_size=30
).map(lambda pairs: tuple(np.array(column) for column in zip(*pairs, strict=True)))


# Paired statistics


@settings(max_examples=8)
@given(errors)
def test_comparing_the_other_way_round_inverts_the_ratio_and_keeps_the_p_value(
    pair: tuple[Array, Array],
) -> None:
    there, back = compare(*pair), compare(*reversed(pair))
    assert there[0] * back[0] == pytest.approx(1.0)
    assert there[2] == pytest.approx(back[2])
    assert there[1] + back[1] + int(np.sum(pair[0] == pair[1])) == len(pair[0])


def test_equal_errors_are_no_difference() -> None:
    same = np.array([0.1, 0.2, 0.3])
    assert compare(same, same) == (1, 0, 1)


# Estimates


def test_with_as_much_motion_of_each_the_longer_one_is_cut() -> None:
    long, short = fitted(np.arange(24.0).reshape(6, 4)), fitted(np.ones((6, 4)))
    fits = {"a": long.model_copy(update={"duration": 20.0}), "b": short}  # 120 s and 48 s
    equal = equal_data(fits)
    assert equal is not None
    assert (equal.cut, equal.repetitions, equal.seconds) == ("a", 2, 40.0)
    assert (equal.other, equal.other_seconds) == ("b", 48.0)
    assert estimates_of(fits)["a-equal"].tolist() == [2.0, 3.0, 4.0, 5.0]
    assert equal_data({"a": short, "b": short}) is None
    assert equal_data({"a": long}) is None


def test_the_distance_to_the_truth_is_one_for_the_base_itself() -> None:
    truth, base = np.zeros(3), np.array([1.0, -2.0, 3.0])
    assert parameter_error(base, base, truth) == pytest.approx(1.0)
    assert parameter_error(-0.5 * base, base, truth) == pytest.approx(0.5)
    assert parameter_error(truth, base, truth) is None


def test_the_planted_values_in_the_units_of_the_print_are_the_manufacturers() -> None:
    cell = Cell.load(CELL_PATH)
    printed = [one for one in parameters_of(cell, planted_values(cell)) if one.printed_id]
    known = [one for one in printed if one.printed_c is not None]
    assert len(printed) == 58 and len(known) == 52
    for one in known:
        assert one.truth is not None and one.printed_c is not None
        assert one.printed_factor * one.truth == pytest.approx(one.printed_c, abs=6e-4), one.name


# A whole study on an arm of two joints


@pytest.fixture(scope="module")
def small() -> StudySettings:
    return study_settings(quick=True, repetitions=2, motions=5, effects=False).model_copy(
        update={
            "motions": 3,
            "effort_a": Effort(population=8, generations=1),
            "effort_b": Effort(population=8, generations=1),
            "fly": (0.0, 0.5),
            "n_via": (6,),
            "coupling_weight": (0.3,),
            "subsets": (1, 2),
            "noise": (1.0,),
        }
    )


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
def whole(
    tmp_path_factory: pytest.TempPathFactory, small: StudySettings, arm: Cell
) -> tuple[Path, StudyResults]:
    """A study that Ctrl-C ended after its first campaign, and that was then started again."""
    root = tmp_path_factory.mktemp("first") / "study"

    def one_and_ctrl_c(executions: Sequence[Execution], *_: object) -> None:
        execute(executions[0])
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hil.study.run.execute_all", one_and_ctrl_c)
        with pytest.raises(KeyboardInterrupt):
            run_study(root, small, Silent(), workers=1, cell=arm)
    assert not (root / "results.json").exists()
    return root, run_study(root, small, Silent(), workers=1, cell=arm)


@pytest.fixture
def no_page(monkeypatch: pytest.MonkeyPatch) -> None:
    """Figures take seconds, and some tests do not look at them."""
    monkeypatch.setattr("hil.study.page.study_page", lambda _: b"")


@pytest.mark.slow
def test_the_study_leaves_results_and_one_self_contained_page(
    whole: tuple[Path, StudyResults],
) -> None:
    root, found = whole
    assert StudyResults.load(root / "results.json") == found
    page = (root / "report.html").read_text("utf-8")
    for part in ("Fig. 1", "Fig. 2", "Fig. 3", "Fig. 4", "Table 1", "Table 2"):
        assert f"paper, {part}" in page
    assert_stands_alone(page)
    assert "SIMULATED ARM" in page
    for paragraph in found.reading:
        assert paragraph.sentences


@pytest.mark.slow
@pytest.mark.usefixtures("no_page")
def test_one_seed_is_one_study_with_any_number_of_processes_and_however_often_interrupted(
    whole: tuple[Path, StudyResults], small: StudySettings, arm: Cell, tmp_path: Path
) -> None:
    root, found = whole
    again = tmp_path / "study"
    # That a search does not depend on them either is tested where searches are.
    shutil.copytree(root / "designs", again / "designs")
    shutil.copy(root / "study.json", again)
    straight = run_study(again, small, Silent(), workers=2, cell=arm)
    not_the_same = {"times": {}, "software": {}}
    texts = [one.model_copy(update=not_the_same).to_json() for one in (found, straight)]
    assert texts[0] == texts[1]


def test_the_kept_forms_give_the_errors_that_the_archives_gave(
    whole: tuple[Path, StudyResults],
) -> None:
    root, found = whole
    (condition,) = found.conditions
    truth = np.array([one.truth for one in found.parameters], dtype=np.float64)
    for one in condition.classes:
        (path,) = (root / "fits" / "plain").glob(f"*-{one.motion_class}.json")
        record = ScoreRecord.model_validate_json(path.read_bytes())
        forms = ClassForms.of(record.forms)
        for method in condition.methods:
            own = np.array(method.mean)
            assert forms.overall(own) == pytest.approx(one.overall[method.key], rel=1e-6)
            assert forms.own(own, truth) == pytest.approx(one.own[method.key], rel=1e-6)


def test_every_estimate_meets_every_class(whole: tuple[Path, StudyResults]) -> None:
    _, found = whole
    assert [one.key for one in found.conditions] == ["plain"]
    for condition in found.conditions:
        cells = {(one.method, one.motion_class) for one in condition.cross}
        classes = ("fly-by", "stop-to-stop", "sinusoid")
        methods = ["a", "b", "b0", "planted"]
        if condition.equal_data is not None:
            methods.append(condition.equal_data.name)
        assert cells == {(m, c) for m in methods for c in classes}
        assert len(condition.comparisons) == 9
        assert all(len(one.archives) == 3 for one in condition.classes)
    assert [one.key for one in found.ablations] == [
        "sines", "fly", "n_via", "weight", "repetitions", "noise",
    ]  # fmt: skip


def test_estimates_of_a_rigid_arm_come_to_the_planted_values(
    whole: tuple[Path, StudyResults],
) -> None:
    _, found = whole
    plain = found.conditions[0]
    truth = np.array([one.truth for one in found.parameters])
    for method in plain.methods:
        assert not method.undetermined
        distance = np.abs(np.array(method.pooled) - truth)
        assert np.mean(distance <= 4.0 * np.array(method.pooled_std)) >= 0.8, method.key


def test_the_planted_values_have_no_error_of_their_own(whole: tuple[Path, StudyResults]) -> None:
    _, found = whole
    for one in found.conditions[0].classes:
        assert set(one.own) >= {"a", "b", "b0"} and "planted" not in one.own
    assert all(point.own for one in found.ablations for point in one.points)


def test_held_out_motions_lie_where_their_class_is(whole: tuple[Path, StudyResults]) -> None:
    root, _ = whole
    for key, name in (("a", "sinusoid"), ("b", "fly-by"), ("b0", "stop-to-stop")):
        run = Run(key, key, root / "campaigns" / "plain" / key)
        assert {one: len(names) for one, names in classes_of(run).items()} == {name: 3}
        first = CampaignFolder(run.root).completed("validation")[0]
        assert class_of(json.loads(open_archive(first).attachments["plan.json"])) == name


@pytest.mark.usefixtures("no_page")
def test_started_again_nothing_whole_is_done_again(
    whole: tuple[Path, StudyResults], small: StudySettings, arm: Cell, tmp_path: Path
) -> None:
    root, found = whole
    copy = shutil.copytree(root, tmp_path / "copy")
    kept = ("designs/*/excitation.toml", "campaigns/*/*/archives/*.mcap", "fits/*/*.json")
    before = {p: p.stat().st_mtime_ns for pattern in kept for p in copy.glob(pattern)}
    assert len(before) > 30
    lost = copy / "campaigns" / "plain" / "b" / "archives" / "excitation_001_a1.mcap"
    lost.unlink()  # as if it had never been written whole
    again = run_study(copy, small, Silent(), workers=1, cell=arm)
    after = {p: p.stat().st_mtime_ns for pattern in kept for p in copy.glob(pattern)}
    new = {path for path in after if after[path] != before.get(path)}
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
    whole: tuple[Path, StudyResults], small: StudySettings, arm: Cell, tmp_path: Path
) -> None:
    root, _ = whole
    again = tmp_path / "study"
    shutil.copytree(root / "designs", again / "designs")
    some = small.model_copy(update={"effects": True, "repetitions": 4})
    some = some.model_copy(
        update={"cell": StudySettings.model_validate_json((root / "study.json").read_text()).cell}
    )
    (again / "study.json").write_text(some.to_json())
    found = run_study(again, some, Silent(), workers=2, cell=arm)
    assert [one.key for one in found.conditions] == ["plain", "effects"]
    plain, effects = found.conditions
    assert effects.effects and not effects.own_comparisons
    assert all(one.repetitions == [4, 4] for one in effects.comparisons)
    assert "too few" not in {one.verdict for one in effects.comparisons}
    errors = [
        next(one.median for one in some.cross if (one.method, one.motion_class) == ("b", "fly-by"))
        for some in (plain, effects)
    ]
    assert errors[1] > errors[0]


def test_other_settings_are_refused_in_the_same_folder(
    whole: tuple[Path, StudyResults], small: StudySettings, arm: Cell
) -> None:
    root, _ = whole
    with pytest.raises(InputError, match="seed: the study in this folder was begun with 1, not 2"):
        run_study(root, small.model_copy(update={"seed": 2}), Silent(), workers=1, cell=arm)
    with pytest.raises(InputError, match="is not empty and holds no study"):
        run_study(root / "fits", small, Silent(), workers=1, cell=arm)


@pytest.mark.usefixtures("no_page")
def test_recorded_campaigns_give_what_they_allow(
    whole: tuple[Path, StudyResults], tmp_path: Path
) -> None:
    root, found = whole
    runs = [
        shutil.copytree(root / "campaigns" / "plain" / key, tmp_path / name)
        for key, name in (("b", "tuesday"), ("a", "monday"))
    ]
    recorded = study_campaigns(tmp_path / "out", runs, Silent(), workers=1)
    (condition,) = recorded.conditions
    # Their excitations tell which is A and which is B, whatever they are called.
    assert [one.label for one in condition.methods] == ["A (monday)", "B (tuesday)"]
    assert recorded.reading[0].heading.startswith("Does B (tuesday) predict")
    assert [one.mean for one in condition.methods] == [
        one.mean for one in found.conditions[0].methods[:2]
    ]
    assert {one.motion_class for one in condition.classes} == {"fly-by", "sinusoid"}
    assert any("stop-to-stop" in sentence for sentence in recorded.missing)
    assert [one.key for one in recorded.ablations] == ["repetitions"]


def test_one_campaign_from_the_command_line(
    whole: tuple[Path, StudyResults], tmp_path: Path
) -> None:
    root, _ = whole
    only = root / "campaigns" / "plain" / "b"
    told = CliRunner().invoke(
        app,
        ["study", "--campaign", str(only), "-o", str(tmp_path / "one"), "--json", "--workers", "1"],
    )
    assert told.exit_code == 0, told.output
    assert any("nothing is compared" in line for line in json.loads(told.stdout)["missing"])
    assert (tmp_path / "one" / "report.html").stat().st_size > 10_000


def test_a_campaign_is_not_run_again_by_a_study(tmp_path: Path) -> None:
    told = CliRunner().invoke(app, ["study", "--quick", "--campaign", str(tmp_path)])
    assert isinstance(told.exception, InputError)
    assert "is recorded already" in str(told.exception)


def test_ctrl_c_leaves_with_one_sentence_and_its_exit_status(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hil.cli.study.run_study", interrupted)
    ended = CliRunner().invoke(app, ["study", "--quick", "-o", str(tmp_path)])
    assert isinstance(ended.exception, OperatorStopError)
    assert ended.exception.exit_code == 130
    assert f"what is complete stays in {tmp_path}" in str(ended.exception)


@pytest.mark.parametrize("count", [1, 2])
def test_a_refusal_in_any_process_is_one_sentence(count: int, tmp_path: Path) -> None:
    with workers_of(count) as workers, pytest.raises(StudyError) as refused:
        workers.map(Cell.load, [(tmp_path / "none.toml",)])
    assert "none.toml" in str(refused.value)


def test_an_excitation_that_the_arm_does_not_bear_ends_the_study_with_its_name(
    whole: tuple[Path, StudyResults], small: StudySettings, arm: Cell, tmp_path: Path
) -> None:
    root, _ = whole
    copy = shutil.copytree(root, tmp_path / "copy")
    found = run_searches(
        StudyFolder(copy), arm, searches(small, 2), Silent(), workers=1
    )  # none is searched again
    plans = plan_study(StudyFolder(copy), arm, small, found)
    ended = {copy / "campaigns" / "ablation" / "b-fly-0": "joint 2: drive fault"}
    left = plans.without(ended)
    assert "b-fly-0" not in left.executions["ablation"]
    assert left.missing == ["b-fly-0 could not be run: joint 2: drive fault"]
    sines = {copy / "campaigns" / "ablation" / "a-middle-fast": "why"}
    assert plans.without(sines).missing
    with pytest.raises(StudyError, match=r"plain/b: this arm cannot bear .* drive fault"):
        plans.without({copy / "campaigns" / "plain" / "b": "drive fault"})
