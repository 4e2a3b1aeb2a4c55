"""What the report shows of choices, friction, the split of torque, spectra, and left-out rows."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from html import unescape

import numpy as np
import pytest

from hil.report import ReportSeries, SeriesError, render_report
from hil.report.figures import (
    excitation_panels,
    friction_curve_panels,
    joints_of,
    spectrum_panels,
    split_panels,
    torque_panels,
)
from hil.report.page import error_rows, every_row_errors, shown_candidates
from hil.results import ChoiceResult, Results
from tests.hil.test_report import JOINTS, TORQUE, Page, make_results, make_series

N = len(JOINTS)
FITTED = {
    "relative_error": [0.02] * N,
    "overall_relative_error": 0.021,
    "all_rows_relative_error": 0.043,
    "all_rows_joint_errors": [0.05] * N,
}


def full_series() -> ReportSeries:
    """A series with everything that figures need."""
    bare = make_series(samples=2000)
    k = bare.example_time.size
    rng = np.random.default_rng(5)
    fitted = np.ones((2000, N))
    fitted[:500] = 0.0
    fitted[1000:1100, 0] = 0.0
    counted = np.ones((k, N))
    counted[-100:] = 0.0
    split = {
        f"example_{part}": share * bare.example_predicted
        for part, share in (("gravity", 0.6), ("inertia", 0.2), ("coriolis", 0.05))
    }
    speed = rng.uniform(-1.0, 1.0, (300, N))
    law_speed = np.repeat(np.linspace(-1.0, 1.0, 40)[:, None], N, axis=1)
    travel = np.repeat(np.linspace(0.0, 6e-4, 30)[:, None], N, axis=1)
    travel[:, 1] = np.nan
    frequency = np.geomspace(0.25, 100.0, 80)
    density = TORQUE / (1.0 + frequency[:, None])
    return replace(
        bare,
        excitation_fitted=fitted,
        example_used=counted,
        example_friction=0.15 * bare.example_predicted,
        **split,
        friction_speed=speed,
        friction_torque=0.1 * TORQUE * (np.sign(speed) + speed),
        law_speed=law_speed,
        law_torque=0.1 * TORQUE * (np.sign(law_speed) + law_speed),
        reversal_travel=travel,
        reversal_torque=0.1 * TORQUE * (1.0 - 2.0 * np.exp(-travel / 1e-4)),
        spectrum_frequency=frequency,
        spectrum_torque=density,
        spectrum_residual=0.1 * density,
        motion_bandwidth=np.full(N, 10.0),
    )


def shaded_in(svg: str) -> list[list[list[float]]]:
    content = json.loads(unescape(re.findall(r'data-traces="([^"]*)"', svg)[0]))
    return [plot["shaded"] for plot in content["plots"]]


def many_choices() -> list[dict[str, object]]:
    errors = [0.5, *(0.2 + 0.01 * k for k in range(9)), None]
    return [
        {"name": "bandwidth of the motion", "candidates": ["10 Hz", "5 Hz"],
         "errors": [0.0612, 0.0655], "chosen": 0},
        {"name": "estimator",
         "candidates": ["least squares", *(f"ridge {k}" for k in range(9)), "failed"],
         "errors": errors, "chosen": 1},
    ]  # fmt: skip


@pytest.fixture(scope="module")
def results() -> Results:
    runs = [run.model_dump() for run in make_results().validation]
    runs = [run | {"all_rows_joint_errors": [0.06] * N} for run in runs]
    return make_results(choices=many_choices(), fitted=FITTED, validation=runs)


@pytest.fixture(scope="module")
def html(results: Results) -> str:
    return render_report(results, full_series())


class TestChoices:
    """The table of settings that inner prediction decided."""

    def test_show_least_squares_and_the_best_five(self, results: Results) -> None:
        estimator = results.choices[1]
        words = [estimator.candidates[k] for k in shown_candidates(estimator)]
        assert words == ["least squares", *(f"ridge {k}" for k in range(5))]

    def test_show_the_chosen_one_even_if_others_predict_better(self) -> None:
        choice = ChoiceResult(
            name="x", candidates=list("abcdefgh"), errors=[0.1] * 7 + [0.9], chosen=7
        )
        shown = shown_candidates(choice)
        assert 7 in shown and len(shown) == 6

    def test_stand_in_the_page_with_errors_and_a_mark(self, html: str) -> None:
        text = Page(html).text
        assert "✓ 10 Hz 6.12" in text and "5 Hz 6.55" in text
        assert "✓ ridge 0 20.00" in text and "least squares 50.00" in text
        assert text.count("Inner prediction:") == 1

    def test_without_choices_there_is_no_table(self) -> None:
        assert "Inner prediction" not in render_report(make_results(), make_series())


class TestErrors:
    """The error over every row beside that of the verdict."""

    def test_stand_side_by_side_for_unseen_and_fitted_motion(self, results: Results) -> None:
        runs = results.validation
        median, worst, fitted = error_rows(results)
        assert fitted == ("fitted", 0.021, 0.043)
        assert median[2] == pytest.approx(0.05) == worst[2]
        assert worst[1] is not None and median[1] is not None
        assert worst[1] >= median[1] > 0.0
        assert f"median of {len(runs)} runs" in median[0]

    def test_are_defined_once_and_before_the_first_section(self, html: str) -> None:
        head = Page(html[: html.index("<main>")])
        rows = head.table("Every row [%]")
        assert [row["Motion"] for row in rows][-1] == "fitted"
        assert Page(html).text.count("standstill and reversals included") == 1

    def test_stand_beside_each_joint(self, results: Results) -> None:
        assert every_row_errors(results) == [0.06] * N
        assert every_row_errors(make_results()) == []
        assert all("every row 6.00 %" in one.error for one in joints_of(results))

    def test_are_those_of_the_fit_where_nothing_was_held_out(self) -> None:
        alone = make_results(fitted=FITTED, validation=[], repetitions=["log.mcap"])
        (row,) = error_rows(alone)
        assert "in-sample" in row[0]
        assert joints_of(alone)[0].error == "error 2.00 %, every row 5.00 %"


class TestShading:
    """Rows that were not fitted, or do not count, in figures over time."""

    def test_covers_the_rows_to_midway_to_the_next(self) -> None:
        series = full_series()
        first, second = (shaded_in(p.svg)[0] for p in excitation_panels(series, JOINTS)[:2])
        assert first == [[0.0, pytest.approx(0.999)], [pytest.approx(1.999), pytest.approx(2.199)]]
        assert second == [[0.0, pytest.approx(0.999)]]

    def test_is_the_same_in_all_plots_of_a_panel(self, results: Results) -> None:
        series, errors = full_series(), joints_of(results)
        end = float(series.example_time[-1] - series.example_time[0])
        for panels, plots in (
            (torque_panels(series, errors), 2),
            (split_panels(series, errors), 1),
        ):
            assert shaded_in(panels[0].svg) == [[[pytest.approx(end - 0.199), end]]] * plots

    def test_is_absent_where_the_series_do_not_say(self) -> None:
        assert shaded_in(excitation_panels(make_series(), JOINTS)[0].svg) == [[], []]


class TestFigures:
    """Friction, split and spectra of each joint."""

    def test_show_every_joint(self, results: Results) -> None:
        series, errors = full_series(), joints_of(results)
        for panels in (
            friction_curve_panels(series, errors),
            split_panels(series, errors),
            spectrum_panels(series, errors),
        ):
            assert [panel.title for panel in panels] == JOINTS

    def test_show_the_reversal_where_dry_friction_turns_round(self, results: Results) -> None:
        first, second = friction_curve_panels(full_series(), joints_of(results))[:2]
        assert "at reversal" in first.svg and "travel [mrad]" in first.svg
        assert "at reversal" not in second.svg

    def test_draw_each_row_of_friction_as_one_dot(self, results: Results) -> None:
        panel = friction_curve_panels(full_series(), joints_of(results))[1]
        longest = max(re.findall(r' d="([^"]*)"', panel.svg), key=len)
        assert longest.count("M") == 300

    def test_name_the_largest_part_of_the_torque(self, results: Results) -> None:
        assert split_panels(full_series(), joints_of(results))[0].note.startswith(
            "largest: gravity"
        )

    def test_name_the_residual_above_the_bandwidth(self, results: Results) -> None:
        note = spectrum_panels(full_series(), joints_of(results))[0].note
        assert "power above 10 Hz" in note

    def test_are_left_out_where_their_series_are_empty(self, results: Results) -> None:
        series, errors = make_series(), joints_of(results)
        assert not friction_curve_panels(series, errors)
        assert not split_panels(series, errors)
        assert not spectrum_panels(series, errors)

    def test_leave_a_joint_out_that_never_moved(self, results: Results) -> None:
        series = full_series()
        series.law_speed[:, 2] = 0.0
        titles = [one.title for one in friction_curve_panels(series, joints_of(results))]
        assert titles == [name for name in JOINTS if name != JOINTS[2]]

    def test_have_ids_of_their_own_and_page_colours(self, html: str) -> None:
        ids = re.findall(r' id="([^"]+)"', html)
        assert len(ids) == len(set(ids))
        assert not re.findall(r"(?:fill|stroke): *#[0-9a-f]{3,6}", html[html.index("<main>") :])

    def test_keep_the_page_small(self, html: str) -> None:
        assert len(html.encode()) < 2_000_000


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("excitation_fitted", np.ones((3, N))),
        ("friction_torque", np.ones((7, N))),
        ("spectrum_residual", np.ones((80, 2))),
        ("motion_bandwidth", np.full(N, np.inf)),
    ],
)
def test_series_of_another_shape_are_refused_by_name(field: str, values: np.ndarray) -> None:
    with pytest.raises(SeriesError, match=field):
        replace(full_series(), **{field: values})
