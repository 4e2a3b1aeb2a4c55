"""The report: one file, verdict first, safe against what archives are called."""

from __future__ import annotations

import base64
import io
import json
import math
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, replace

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.image import imread

from hil.report import figures, finding_pictures, numbers, page
from hil.report.chart import Caption, Chart, Plot, Trace, thinned
from hil.report.interactive import chart_data, encoded
from hil.report.page import report_bytes
from hil.report.panels import chart_panel, matrix_panel
from hil.report.rendering import environment
from hil.results.results import ChoiceResult, Results
from hil.results.series import ReportSeries, SeriesError
from identification.excitation import CRITERIA, METHODS
from identification.excitation.criteria import Criterion
from identification.validation.finding_messages import SENTENCES
from identification.validation.purpose import Purpose
from sim_fixtures.ns16 import N_ESSENTIAL
from tests.hil.report.pages import (
    HOSTILE,
    JOINTS,
    Page,
    _criteria,
    _judgement,
    assert_inert,
    assert_stands_alone,
    make_results,
    make_series,
    with_joints,
)

pytestmark = pytest.mark.long


FIXED_WORDS = {"N·m", "good", "doubtful", "condition"}  # nothing else gets past the schema


def real_recording():
    """One imported recording: no truth, no plan, one way to a standard deviation, one run."""
    whole = make_results()
    unknown = {"truth": None, "table2_id": None, "repetition_std": None}
    return make_results(
        simulated=False,
        effects=[],
        coverage=None,
        repetitions=["log.mcap"],
        notes=[],
        excitation={
            "duration": 9.0,
            "n_via": None,
            "fly": None,
            "planned": None,
            "coupling_index_max": 1653.0,
            "executed": _criteria(70.0, 130.0),
        },
        parameters=[p.model_dump() | unknown for p in whole.parameters],
        validation=[whole.validation[0].model_dump()],
        verdict={"good": False, "line": "Off by 24 %.", "reasons": [], "warnings": []},
    )


# fmt: on


def many_choices():
    errors = [0.5, *(0.2 + 0.01 * k for k in range(9)), math.inf]
    return [
        {"name": "bandwidth of the motion", "candidates": ["10 Hz", "5 Hz"],
         "errors": [0.0612, 0.0655], "chosen": 0},
        {"name": "estimator",
         "candidates": ["least squares", *(f"ridge {k}" for k in range(9)), "failed"],
         "errors": errors, "chosen": 1},
    ]  # fmt: skip


STEPS = [
    {"step": "rehearsal", "done": True, "words": "6 of 6 criteria passed", "details": []},
    {"step": "dry run", "done": True, "words": "accepted by ada", "details": ["2 late"]},
    {
        "step": "warm-up",
        "done": False,
        "words": "not warm",
        "details": ["still 1.3%"],
        "warning": True,
    },
]
"""Conduct of a campaign."""


@pytest.fixture(scope="module")
def results():
    """Of a campaign, with everything that a page can show."""
    return make_results(choices=many_choices(), conduct={"steps": STEPS})


@pytest.fixture(scope="module")
def html(results):
    return render(results)


@pytest.fixture(scope="module")
def whole(html):
    return Page(html)


def render(results, series=None):
    return report_bytes(results, series or make_series(samples=200)).decode()


PARTS = ("inertia", "coriolis", "gravity", "friction", "elements")


def rendered_of(results, series):
    return report_bytes(results, series).decode()


def legends_of(html):
    return " ".join(re.findall(r'<ul class="legend">.*?</ul>', html, re.S))


def torque_chart(series, results):
    return figures.torque_charts(series, figures.joints_of(results))[0]


def rendered(results):
    return Page(render(results))


ESSENTIAL = {
    "reason": "2 of 58 are essential", "cut": 1, "refused": ["f1_1"],
    "steps": [{"removed": name, "left": 2, "spread": 3.0, "in_sample": 0.02, "held_out": 0.02,
               "largest_relative_std": 0.1} for name in (None, "f0_2")],
    "parameters": [{"name": "f1_1", "unit": "N·m·s/rad", "estimate": 8.0, "std": 0.1}],
}  # fmt: skip
CONSISTENCY = {
    "sentence": "consistent parameters predict as well", "impossible": False, "costly": False,
    "held_out": 0.02, "unconstrained_held_out": 0.02, "in_sample": 0.02, "shift": [0.0],
    "unconstrained_in_sample": 0.02, "moved": ["mc2x", "f0_1"], "status": "solved",
    "bounds": ["rotor inertia of elbow would be negative (-0.3)"],
    "links": [{"joint": "<script>alert(1)", "mass": 12.34, "centre": [0.1, 0.2, 0.3],
               "rotor_inertia": 0.5, "room": 0.5, "reference": "nominal"}],
}  # fmt: skip


class TestPage:
    def test_has_the_verdict_first_and_details_folded(self, html):
        order = ["predicts unseen motion to 1.5\u00a0% of the torque", "SIMULATED", 'id="torque"',
                 'id="judgement"', "Torque error over all joints", 'id="files"',
                 'id="friction"', 'id="parameters"', 'id="trust"', '<details id="appendix">',
                 'id="run"', 'id="excitation"', 'id="estimation"', 'id="correlation"']  # fmt: skip
        places = [html.index(mark) for mark in order]
        assert places == sorted(places)
        assert places[0] < html.index("Figure 1")
        assert html.rindex("</details>") > places[-1]

    @pytest.mark.parametrize(("good", "word"), [(True, "GOOD"), (False, "NOT GOOD")])
    def test_has_word_and_symbol_of_the_verdict(self, good, word):
        verdict = {"good": good, "line": "So it is.", "reasons": ["because"], "warnings": []}
        text = render(make_results(verdict=verdict))
        card = text[text.index('<section class="verdict') :].split("</section>")[0]
        first = "1 warning , by rank . First: not white."
        assert Page(card).text == f"{word} So it is. because {first}"
        assert 'class="badge"' in card

    def test_names_what_was_simulated(self, whole):
        assert "SIMULATED. No robot moved" in whole.text
        assert all(effect in whole.text for effect in make_results().effects)
        assert "lower bound" not in whole.text
        assert "lower bound" in rendered(make_results(effects=[])).text
        linked = rendered(make_results(simulated_by_unknown=True)).text
        assert "no true parameters are shown" in linked
        assert "No robot moved" not in linked
        assert not any(effect in linked for effect in make_results().effects)
        recording = rendered(real_recording())
        assert not {"simulated", "truth:", "planned"} & set(recording.text.lower().split())
        assert not any("Truth" in rows[0] for rows in recording.tables)
        assert len(recording.table("Estimate")) == 58

    def test_stands_alone_with_figures_and_tables_in_order(self, html, whole):
        assert_stands_alone(html)
        assert len(set(re.findall(r'(?:href="|url\()#([^")]*)', html))) > 50
        drawings = [a for tag, a in whole.tags if tag == "svg" and a.get("role") == "img"]
        assert all(len(a["aria-label"] or "") > 30 for a in drawings)
        assert sum(tag == "h1" for tag, _ in whole.tags) == 1
        assert sum(tag == "caption" for tag, _ in whole.tags) == len(whole.tables)
        for kind, count in (("Figure", 6), ("Table", len(whole.tables))):
            # of the views of one figure, 1a, 1b and so on, one is visible
            numbers = re.findall(rf"<b>{kind} (\d+)a?\.</b>", html)
            assert numbers == [str(k) for k in range(1, count + 1)]

    def test_bytes_do_not_depend_on_thread_or_settings(self):
        settings = {"lines.linestyle": ":", "svg.fonttype": "path", "text.usetex": True}
        series = make_series(samples=200)
        with mpl.rc_context(settings), ThreadPoolExecutor(2) as pool:
            pages = list(pool.map(lambda _: report_bytes(make_results(), series), range(2)))
            assert {key: mpl.rcParams[key] for key in settings} == settings
        assert set(pages) == {report_bytes(make_results(), series)}

    def test_names_from_archives_are_escaped(self, results):
        def spoil(value):
            if isinstance(value, list):
                return [spoil(v) for v in value]
            if isinstance(value, dict):
                end = HOSTILE if "hil" in value else ""  # the keys of `software` are names too
                return {k + end: spoil(v) for k, v in value.items()}
            hostile = isinstance(value, str) and value not in FIXED_WORDS
            return value + HOSTILE if hostile else value

        spoilt = Results.model_validate(spoil(results.model_dump()))
        rendered_page = Page(render(spoilt, make_series(samples=200, name="v" + HOSTILE)))
        assert_inert(rendered_page)
        assert "{{7*7}}" in rendered_page.text
        assert "<script>alert(1)</script>" in rendered_page.text
        # Also characters that change the direction of text.
        text = environment().from_string("{{ name }}|{{ same }}|{{ number }}")
        name = "a\u202eb\x1b[31m\u2066c\x7f"
        same = "1\u2009234\u00a0N\n\té"
        shown = text.render(name=name, same=same, number=3)
        assert shown == r"a\u202eb\x1b[31m\u2066c\x7f" + f"|{same}|3"

    def test_of_one_joint_without_friction_or_validation(self):
        whole = real_recording()

        def first(section):
            fields = section.model_dump().items()
            return {key: value[:1] if isinstance(value, list) else value for key, value in fields}

        alone = whole.model_dump() | {
            "joint_names": ["q"], "parameters": [whole.parameters[5].model_dump()], "n_base": 1,
            "correlation": [[1.0]], "noise_std": [0.1], "validation": [],
            "judgement": first(whole.judgement), "fitted": first(whole.fitted),
            "repetition_values": [[1.0] for _ in whole.repetitions],
            "excitation": whole.excitation.model_dump()
            | {"executed": _criteria(1.0, 1.0) | {"condition": math.inf}},
        }  # fmt: skip
        rendered_page = Page(render(Results.model_validate(alone), make_series(joints=1)))
        assert "Nothing was held out" in rendered_page.text

    def test_shows_every_criterion_and_the_words_of_the_method(self, monkeypatch):
        """Rows of `CRITERIA` and `METHODS`."""
        other = Criterion(lambda *_: 1.0, "κ", -1.0, "Spread of Φ", "of all", 3, relative=True)
        monkeypatch.setitem(CRITERIA, "condition", other)
        text = rendered(make_results()).text
        assert "Spread of Φ" in text and "of all; lower is better" in text
        assert "48210.000" in text
        for name, method in METHODS.items():
            motion = make_results().excitation.model_copy(update={"method": name})
            assert method.label in render(make_results().model_copy(update={"excitation": motion}))

    def test_shows_the_chosen_candidate_and_the_best(self, results, whole):
        estimator = results.choices[1]
        shown = [estimator.candidates[k] for k in page.shown_candidates(estimator)]
        assert shown == ["least squares", *(f"ridge {k}" for k in range(5))]
        worst = ChoiceResult(
            name="x", candidates=list("abcdefgh"), errors=[0.1] * 7 + [0.9], chosen=7
        )
        assert 7 in page.shown_candidates(worst) and len(page.shown_candidates(worst)) == 6
        assert "✓ 10 Hz 6.12" in whole.text and "5 Hz 6.55" in whole.text
        assert "✓ ridge 0 20.00" in whole.text and "least squares 50.00" in whole.text
        assert whole.text.count("Inner prediction (cross-validation):") == 1
        assert "Inner prediction" not in rendered(make_results()).text

    def test_has_errors_of_unseen_and_fitted_motion(self, html):
        part = Page(html[html.index('<section id="judgement">') :])
        median, worst, fitted = (list(row.values()) for row in part.table("Motion"))
        assert fitted == ["fitted", "4.30", "2.10"]
        assert median[1] == "5.00" == worst[1]
        assert float(worst[2]) >= float(median[2]) > 0.0
        assert "median of 12 runs" in median[0]
        assert Page(html).text.count("includes standstill and reversals") == 1
        assert "whole recording" in Page(html).text and "in motion" in Page(html).text

    def test_has_findings_with_next_step_and_figure(self):
        """Without joints of its own, it shows the joint with the largest error."""
        step = "fit a longer motion"
        finding = {"check": "generalisation", "level": "wrong", "words": "it grew"}
        passed = {"check": "saturation", "level": "good", "words": "none saturated"}
        findings = [passed, finding | {"next_step": step, "role": "symptom"}]
        html = render(make_results(judgement=_judgement() | {"findings": findings}))
        section = html[html.index('<ol class="found">') :].split("</ol>")[0]
        assert "✕ failed it grew Next: fit a longer motion." in Page(section).text
        assert 'href="#torque"' in section and "<svg" in section
        assert "none saturated" not in Page(section).text
        assert html.count("it grew") == 1
        assert [row["Finding"] for row in Page(html).table("Check")] == ["none saturated"]

    def test_a_finding_is_shown_by_a_joint_that_it_names(self):
        """The worst of its joints, also where another joint has a larger error."""
        judgement = _judgement()
        for error, joint in zip(
            (0.02, 0.05, 0.04, 0.09, 0.02, 0.02), judgement["joints"], strict=True
        ):
            joint["relative"] = error
        finding = {"check": "generalisation", "level": "doubtful", "words": "it grew"}
        for named, shown in (([0, 1, 2], JOINTS[1]), ([], JOINTS[3])):
            judgement["findings"] = [finding | {"joints": named}]
            html = render(make_results(judgement=judgement))
            section = html[html.index('<ol class="found">') :].split("</ol>")[0]
            assert f"{shown} : measured and predicted torque" in Page(section).text

    @pytest.mark.parametrize("check", sorted({each.check for each in SENTENCES.values()}))
    def test_every_finding_has_a_picture_or_a_section(self, check):
        if check != "{change:check}":  # of a sign, an order or an angle
            assert finding_pictures.picture_of(check, "") is not None

    @pytest.mark.parametrize(
        ("check", "key", "what"),
        [
            ("torque constant", "", "measured torque over the torque of the identified model"),
            ("scale of the torque", "", "measured torque over the torque of the nominal model"),
            ("friction over time", "", "friction over velocity, first third"),
            ("friction law", "", "friction over velocity"),
            ("outliers", "", "torque of held-out motion"),
            ("zeros", "", "mean residual over position"),
            ("clock", "retimed", "intervals between time stamps"),
        ],
    )
    def test_a_finding_has_the_picture_that_shows_it(self, check, key, what):
        series = replace(make_series(), clock_time=np.array([0.0, 0.01, 0.03, 0.04]))
        finding = {"check": check, "level": "doubtful", "words": "it is", "key": key}
        html = render(make_results(judgement=_judgement() | {"findings": [finding]}), series)
        section = html[html.index('<ol class="found">') :].split("</ol>")[0]
        assert what in Page(section).text
        assert section.count("<svg") == 1

    def test_a_picture_is_shown_once(self):
        judgement = _judgement()
        finding = {"check": "generalisation", "level": "doubtful", "words": "it grew"}
        same = {"check": "delay", "level": "doubtful", "words": "it lags"}
        judgement["findings"] = [finding, same]
        section = render(make_results(judgement=judgement))
        section = section[section.index('<ol class="found">') :].split("</ol>")[0]
        assert section.count("<svg") == 1
        assert "shown in torque" in Page(section).text

    def test_reasons_do_not_repeat_the_sentence_of_the_verdict(self):
        words = ["2 kg more", "the error is large"]
        findings = [
            {"check": "load", "level": "wrong", "words": words[0], "role": "cause"},
            {"check": "overall", "level": "wrong", "words": words[1], "role": "symptom"},
        ]
        line = "The model must not be relied on: 2 kg more."
        verdict = {"good": False, "line": line, "reasons": words, "warnings": [], "headline": 0}
        html = render(
            make_results(verdict=verdict, judgement=_judgement() | {"findings": findings})
        )
        section = html[html.index('class="verdict') :].split("</section>")[0]
        assert re.findall(r"<li>(.*?)</li>", section) == [words[1]]

    def test_ranks_findings_by_role_and_by_what_they_explain(self):
        found = {
            "few runs": ("condition", None),
            "wrist off": ("symptom", None),
            "late": ("cause", 0.3),
            "negated": ("cause", 0.9),
        }
        findings = [
            {"check": "x", "level": "doubtful", "words": words, "role": role, "explains": share}
            for words, (role, share) in found.items()
        ]
        warnings = [*found, "a note on the source"]
        verdict = {"good": True, "line": "Good.", "reasons": [], "warnings": warnings}
        judgement = _judgement() | {"findings": findings}
        page = render(make_results(verdict=verdict, judgement=judgement))
        section = page[page.index('<ol class="found">') :].split("</ol>")[0]
        words = re.findall(r'<span class="words">(.*?)</span>', section)
        assert words == [*reversed(found), "a note on the source"]
        assert "5 warnings , by rank . First: negated." in Page(page).text

    def test_begins_with_what_the_model_is_good_for(self):
        purposes = [
            Purpose("feed-forward", True, 0.06, 0.2, references={"nominal with friction": 0.41}),
            Purpose("simulation", False, 0.012, 0.005, "m", references={"horizon": 0.2}),
            Purpose("contact", None, 42.0, None, "N"),
        ]
        verdict = {
            "good": False,
            "line": "So.",
            "reasons": [],
            "warnings": [],
            "purposes": [asdict(purpose) for purpose in purposes],
        }
        html = render(make_results(verdict=verdict))
        rows = Page(html).table("Purpose")
        assert [row["Good"] for row in rows] == ["✓ yes", "✕ no", "–"]
        assert rows[0]["Figure"].startswith("6.0\u00a0% of the torque left")
        assert rows[1]["Good if"] == "at most 5 mm"
        assert html.index("Feed-forward") < html.index('id="torque"')

    def test_shows_offsets_under_their_own_name(self):
        results = make_results()
        change = {"name": "fo_1", "of_this_run": False, "table2_id": None}
        offset = results.parameters[-1].model_copy(update=change)
        friction = [p.model_copy(update={"of_this_run": True}) for p in results.parameters]
        parameters = [*results.parameters[: results.n_base], *friction[results.n_base :], offset]
        text = rendered(results.model_copy(update={"parameters": parameters})).text
        assert "Offsets of the torque (1)" in text
        assert "Elements" not in text

    def test_writes_shares_of_messages_as_those_of_tables(self):
        verdict = {"good": False, "line": "off by 2.1% of 5%.", "reasons": ["a 3%"], "warnings": []}
        text = rendered(make_results(verdict=verdict)).text.replace("\xa0", " ")
        assert "off by 2.1 % of 5 %." in text and "a 3 %" in text

    def test_has_dates_to_the_minute_and_who_did_it(self):
        occasion = {
            "recorded_from": "2026-11-02T08:15:30+00:00",
            "identified_at": "2026-11-26T12:30:04.25Z",
            "operator": "ada",
            "serial_number": "4711",
            "notes": "wet",
        }
        text = rendered(make_results(occasion=occasion)).text
        for phrase in ("2026-11-02 08:15 UTC", "2026-11-26 12:30 UTC", "ada", "4711", "wet"):
            assert phrase in text

    def test_shows_steps_of_the_campaign_if_known(self, whole):
        for phrase in ("Execution", "6 of 6 criteria passed", "Accepted by ada", "2 late"):
            assert phrase in whole.text
        assert "▲ Not warm" in whole.text and "still 1.3 %" in whole.text
        assert "Execution" not in rendered(make_results()).text


class TestParameters:
    def test_are_in_a_table(self, whole, results):
        rows = whole.table("Estimate")
        parameters = results.parameters
        assert [row["Id"] for row in rows] == [str(p.table2_id) for p in parameters]
        for row, p in zip(rows, parameters, strict=True):
            half = 0.06 * p.std  # numbers are rounded at the second digit of std
            for column, value, error in (
                ("Estimate", p.estimate, half),
                ("Truth", p.truth, half),
                ("± std", p.std, half),
                ("95 % from", p.estimate - 2.05 * p.std, half),
                ("95 % to", p.estimate + 2.05 * p.std, half),
                ("(est. − truth) / std", (p.estimate - p.truth) / p.std, 0.0051),
                ("Std over rep.", p.repetition_std, 0.06 * p.repetition_std),
            ):
                assert float(row[column]) == pytest.approx(value, abs=error), column

    def test_are_in_the_order_of_their_numbers(self):
        parameters = [p.model_dump() for p in make_results().parameters]
        base = parameters[:N_ESSENTIAL][::-1]
        page = rendered(make_results(parameters=[*base, *parameters[N_ESSENTIAL:]]))
        rows = page.table("Estimate")
        ids = [int(row["Id"]) for row in rows]
        assert ids[:N_ESSENTIAL] == sorted(ids[:N_ESSENTIAL])
        joints = {row["Name"]: row["Expression"] for row in rows}
        assert joints["f0_2"].strip() == "joint_2" and "joint_5" in joints["f1_5"]

    def test_that_are_off_or_not_significant_are_marked(self):
        cases = [
            (10.0, 8.1, ""), (10.0, 7.9, "▲ outside 2σ"), (10.0, 13.1, "■ outside 3σ"),
            (1.9, 1.0, "○ not significant"), (1.9, 5.0, "■ outside 3σ, ○ not significant"),
        ]  # fmt: skip
        parameters = [p.model_dump() for p in make_results().parameters]
        for parameter, (estimate, truth, _) in zip(parameters, cases, strict=False):
            parameter |= {"estimate": estimate, "truth": truth, "std": 1.0}
        rows = rendered(make_results(parameters=parameters)).table("Estimate")
        remarks = [row["Remark"].replace("\xa0", " ") for row in rows]
        assert remarks[: len(cases)] == [remark for *_, remark in cases]

    def test_show_the_share_of_the_data_beside_that_of_the_prior(self):
        parameters = [p.model_dump() for p in make_results().parameters]
        parameters[0] |= {"prior_std": 1.0, "prior_ratio": 0.5}
        parameters[1] |= {"prior_std": math.inf, "prior_ratio": 0.0}
        html = render(make_results(parameters=parameters))
        assert (
            'aria-label="75 % from the data, 25 % from the prior"><span style="width:75%">' in html
        )
        assert html.count('class="share"') == len(parameters) - 1
        for parameter in parameters:
            parameter |= {"prior_std": None, "prior_ratio": None}
        assert 'class="share"' not in render(make_results(parameters=parameters))

    def test_have_a_matrix_of_correlation_from_white_to_black(self, results):
        svg = matrix_panel(figures.correlation_matrix(results)).svg
        image = re.findall(r"data:image/png;base64,\s*([^\"]*)", svg)[0]
        pixels = imread(io.BytesIO(base64.b64decode(image)))[..., :3]
        assert pixels.shape == (40, 40, 3)
        expected = np.abs(np.array(results.correlation)[:40, :40])
        np.testing.assert_allclose(1.0 - pixels.mean(axis=2), expected, atol=0.02)

    def test_figure_and_summary_have_the_order_of_the_table(self, results):
        """Of the parameters estimated first and last the numbers are exchanged."""
        parameters = [p.model_dump() for p in results.parameters]
        first = parameters[0]
        last = parameters[N_ESSENTIAL - 1]
        ids = last["table2_id"], first["table2_id"]
        for parameter, number in zip((first, last), ids, strict=True):
            values = {"estimate": 0.0, "std": 1.0, "truth": -4.0}
            parameter |= {"table2_id": number, **values}
        exchanged = make_results(parameters=parameters)
        svg = matrix_panel(figures.correlation_matrix(exchanged)).svg
        pattern = rf">(\d+ (?:{first['name']}|{last['name']}))<"
        labels = [*dict.fromkeys(re.findall(pattern, svg))]  # beside rows and columns
        assert labels == [f"{ids[1]} {last['name']}", f"{ids[0]} {first['name']}"]
        (furthest,) = re.findall(r"more than 3σ \([^)]*\): ([^.]*)\.", Page(render(exchanged)).text)
        numbers = [int(label.split()[0]) for label in furthest.split(", ")]
        assert {*ids} <= {*numbers} and numbers == sorted(numbers)
        labels = exchanged.not_significant
        assert {*ids} <= {*(numbers := [int(label.split()[0]) for label in labels])}
        assert numbers == sorted(numbers)

    @pytest.mark.parametrize(
        ("std", "grade"),
        [
            (0.1, "within 10 %"),
            (0.5, "within 50 %"),
            (0.6, "not identified"),
            (math.inf, "undetermined"),
        ],
    )
    def test_are_graded_by_relative_standard_deviation(self, std, grade):
        parameter = make_results().parameters[0].model_copy(update={"estimate": 1.0, "std": std})
        assert parameter.grade == grade

    def test_essential_and_consistent_ones_are_explained(self):
        page = rendered(make_results(essential=ESSENTIAL, consistency=CONSISTENCY))
        for phrase in (
            "2 of 58 are essential",
            "removed: f0_2",
            "needed for held-out motion",
            "by more than three standard deviations: mc2x, f0_1.",
            *CONSISTENCY["bounds"],
        ):
            assert phrase in page.text
        assert_inert(page)
        names = [row["Name"] for row in page.table("With all parameters")]
        assert names == ["f1_1 joint_1"]
        (link,) = page.table("Link of")
        assert link["Mass [kg]"] == "12.3" and link["Link of"] == "<script>alert(1)"
        without = rendered(make_results()).text
        assert "Essential parameters" not in without and "Physical consistency" not in without

    def test_essential_ones_say_whether_the_selection_moved_them(self):
        parameters = [p.model_dump() for p in make_results().parameters]
        estimates = {"selected": (1.05, 2.0), "off": (1.5, 2.0), "right": (1.0, 1.05)}
        rows = []
        for parameter, (name, (full, essential)) in zip(
            parameters, estimates.items(), strict=False
        ):
            parameter |= {"name": name, "truth": 1.0, "std": 0.1, "estimate": full}
            rows.append({"name": name, "unit": "kg m", "estimate": essential, "std": 0.1})
        essential = ESSENTIAL | {"parameters": rows, "refused": []}
        html = render(make_results(parameters=parameters, essential=essential))
        table = Page(html[html.index('<section id="trust">') :]).table("With all parameters")
        remarks = [row["Remark"].replace("\xa0", " ") for row in table]
        assert remarks == ["beyond 3σ by the selection", "beyond 3σ, also with all parameters", ""]
        assert "absorb the effect of the removed parameters" in Page(html).text


class TestFigures:
    """A panel for each joint; rows that do not count are shaded."""

    def test_show_every_joint_that_moved(self, results):
        series = make_series()
        joints = figures.joints_of(results)
        series.law_speed[:, 2] = 0.0
        for panels, expected in (
            (figures.excitation_charts(series, joints), JOINTS),
            (figures.torque_charts(series, joints), JOINTS),
            (figures.part_charts(series, joints), JOINTS),
            (figures.spectrum_charts(series, joints), JOINTS),
            (figures.friction_charts(series, joints), [*JOINTS[:2], *JOINTS[3:]]),
        ):
            panels = [chart_panel(chart) for chart in panels]
            assert [drawn.title for drawn in panels] == expected
            assert all(drawn.svg.count("<path") >= 4 for drawn in panels)
            assert [drawn.joint for drawn in panels] == [JOINTS.index(name) for name in expected]

    def test_a_joint_that_stands_has_no_error_in_motion(self, results):
        run = results.validation[0]
        standing = run.model_copy(update={"relative_error": [math.nan, *run.relative_error[1:]]})
        captions = [
            joint.error
            for joint in figures.joints_of(results.model_copy(update={"validation": [standing]}))
        ]
        assert captions[0].startswith("error in motion –, whole recording ")
        assert not any("– %" in caption for caption in captions)

    def test_show_the_nominal_model_where_it_is_known(self, results):
        series = make_series(samples=200)
        names = [[t.name for t in p.traces] for p in torque_chart(series, results).plots]
        assert names == [["measured", "nominal", "predicted"], ["nominal residual", "residual"]]
        without = replace(series, example_nominal=None)
        names = [[t.name for t in p.traces] for p in torque_chart(without, results).plots]
        assert names == [["measured", "predicted"], ["residual"]]
        assert "nominal model" in legends_of(rendered_of(results, series))
        assert "nominal model" not in legends_of(rendered_of(results, without))

    def test_a_poor_nominal_model_leaves_the_plot_readable(self, results):
        series = make_series(samples=200)
        poor = replace(series, example_nominal=1e4 * series.example_predicted)
        for good, other in zip(
            torque_chart(replace(series, example_nominal=None), results).plots,
            torque_chart(poor, results).plots,
            strict=True,
        ):
            span = good.y_limits[1] - good.y_limits[0]
            assert other.y_limits[1] - other.y_limits[0] <= 3.0001 * span

    def test_of_torques_of_zero_and_of_one_row_are_drawn(self, results):
        series = make_series(samples=200)
        examples = {k: v for k, v in series.arrays.items() if k.startswith("example_")}
        nothing = {k: np.zeros_like(v) for k, v in series.arrays.items()
                   if k.startswith(("example_", "spectrum_m", "spectrum_r"))}  # fmt: skip
        nothing |= {"example_time": series.example_time}
        nothing |= {"friction_torque": np.full_like(series.friction_torque, np.nan)}
        for change in (nothing, {k: v[:1] for k, v in examples.items()},
                       {k: v[:0] for k, v in examples.items()}):  # fmt: skip
            assert "NaN" not in rendered_of(results, replace(series, **change)).split("<script")[0]

    def test_of_a_file_of_an_earlier_version_have_no_tabs(self, results):
        arrays = make_series(samples=200).arrays | {"example_archive": "v.mcap"}
        needed = {k: v for k, v in arrays.items() if k[:8] != "spectrum" and k[8:] not in PARTS}
        series = ReportSeries.from_arrays(needed)
        page = Page(rendered_of(results, series))
        assert "Spectrum of the error" not in page.text and "Torque by part" not in page.text
        with pytest.raises(KeyError, match="law_speed"):
            ReportSeries.from_arrays({k: v for k, v in needed.items() if k != "law_speed"})

    def test_are_small_enough_for_one_file_of_fifteen_joints(self):
        results = with_joints(make_results(), 15)
        series = make_series(samples=20_000, joints=15)
        assert len(report_bytes(results, series)) < 3_000_000

    def test_shade_rows_to_midway_to_the_next(self):
        used = np.array([[0.0], [1.0], [1.0], [0.0], [1.0]])
        assert figures._left_out(np.arange(5.0), used, 0) == ((0.0, 0.5), (2.5, 3.5))

    @pytest.mark.parametrize(
        ("field", "values"),
        [
            ("excitation_velocity", np.zeros((3, 6))),
            ("example_used", np.ones((3, 6))),
            ("friction_torque", np.ones((7, 6))),
            ("law_torque", np.full((40, 6), np.inf)),
        ],
    )
    def test_refuse_series_that_do_not_fit_by_name(self, field, values):
        with pytest.raises(SeriesError, match=field.partition("_")[0]):
            replace(make_series(), **{field: values})
        with pytest.raises(SeriesError):
            render(make_results(), make_series(joints=5))

    @given(
        st.lists(
            st.one_of(st.floats(-1e6, 1e6), st.just(math.nan)), min_size=1, max_size=300
        ).filter(lambda values: not np.all(np.isnan(values)))
    )
    def test_values_for_the_script_are_exact_to_a_65534th(self, values):
        code = encoded(np.array(values))
        numbers = np.frombuffer(base64.b64decode(code["codes"]), "<i2").astype(float)
        read = np.where(numbers == -32768, np.nan, code["middle"] + code["step"] * numbers)
        span = np.nanmax(values) - np.nanmin(values)
        np.testing.assert_allclose(read, values, rtol=1e-12, atol=span / 65534 + 1e-300)

    def test_for_the_script_have_the_peaks_of_a_long_recording(self, results):
        series = make_series(samples=60_000)
        series.example_measured[777, 0] = 1e4
        data = json.loads(chart_data({"torques": [torque_chart(series, results)]}, JOINTS))
        trace = data["groups"]["torques"][0]["plots"][0]["traces"][0]
        assert trace["y"]["middle"] + 32767 * trace["y"]["step"] == pytest.approx(1e4)
        assert len(trace["y"]["codes"]) < 12_000

    @given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=3000), st.integers(1, 200))
    def test_thinning_leaves_order_ends_and_every_peak(self, values, bins):
        time = np.arange(float(len(values)))
        signal = np.array(values)
        thin_time, thin = thinned(time, signal, bins)
        assert thin.size <= 2 * bins + 2
        assert np.all(np.diff(thin_time) > 0)
        assert (thin_time[0], thin_time[-1]) == (time[0], time[-1])
        assert (thin.min(), thin.max()) == (signal.min(), signal.max())


class TestNumbers:
    @given(st.floats(-1e12, 1e12), st.floats(1e-12, 1e9))
    def test_read_back_unchanged(self, value, std):
        assert float(numbers.significant(value)) == pytest.approx(value, rel=0.0051)
        assert abs(float(numbers.beside(value, std)) - value) <= 0.06 * std + 1e-9 * abs(value)

    @pytest.mark.parametrize(
        ("value", "std", "text"),
        [
            *[(71.6987, 0.4512, "71.70"), (71.6987, 31.0, "72"), (9.996, 0.0996, "10.00")],
            *[(-0.00004, 0.02, "0.000"), (1.23456e-9, 2.2e-11, "1.235e-9")],
            (5.0, math.nan, "5.000"),
        ],
    )
    def test_are_rounded_where_uncertainty_begins(self, value, std, text):
        assert numbers.beside(value, std) == text


def one_chart(values, x=None, **changes):
    """A chart of one line in black."""
    x = np.arange(float(len(values))) if x is None else x
    plot = Plot(110.0, "torque [N·m]", [Trace(np.asarray(values), "var(--ink)", 1.0)])
    return Chart(Caption("t0", "joint_1", "", "torque over time"), x, [plot], **changes)


def texts_of(panel, anchor):
    """Texts of a picture with this anchor; labels of the vertical axis end at it."""
    return re.findall(rf"<text style=[^>]*text-anchor:{anchor}[^>]*>([^<]*)<", panel.svg)


class TestPictures:
    @given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6))
    @settings(max_examples=25)
    def test_have_at_least_three_ticks_of_y_that_differ(self, low, span):
        texts = texts_of(chart_panel(one_chart([low, low + max(span, 1e-6 * abs(low))])), "end")
        assert len(texts) >= 3 and len(set(texts)) == len(texts)

    @pytest.mark.parametrize("values", [[0.3, 40.0], [1e-9, 1e9], [1.2, 1.9]])
    def test_of_spectra_have_ticks_of_both_axes(self, values):
        chart = one_chart(values, np.array([1.0, 80.0]), log=True)
        limits = 0.8 * min(values), 1.25 * max(values)
        panel = chart_panel(replace(chart, plots=[replace(chart.plots[0], limits=limits)]))
        shown = [float(text.replace("−", "-")) for text in texts_of(panel, "end") if text]
        assert shown and all(0.5 * values[0] <= value <= 2.0 * values[1] for value in shown)

    def test_have_a_grid_line_at_every_number(self):
        panel = chart_panel(one_chart([0.0, 1.0, 0.0]))
        (grid,) = re.findall(r'd="([^"]*)"[^>]*stroke:var\(--grid\)', panel.svg)
        lines = [[float(x) for x in part.split()] for part in grid.split("M")[1:]]
        upright = [line for line in lines if line[0] == line[2]]
        level = [line for line in lines if line[1] == line[3]]
        assert len(level) == len(texts_of(panel, "end"))
        columns = [
            float(x) for x in re.findall(r'text-anchor:middle[^>]* x="([^"]*)"[^>]*>\d', panel.svg)
        ]
        assert [line[0] for line in upright] == pytest.approx(columns, abs=0.2)

    def test_have_the_factor_of_small_numbers_before_the_quantity(self):
        panel = chart_panel(one_chart([0.0, 1e-9]))
        (factor,) = re.findall(
            r'<text style="[^"]*text-anchor:end[^"]*"[^>]*>([^<]*e−9)<', panel.svg
        )
        assert factor == "1e−9"

    def test_interrupt_a_line_at_nan(self):
        panel = chart_panel(one_chart([0.0, 1.0, np.nan, 1.0, 0.0]))
        (line,) = re.findall(r'd="([^"]*)"[^>]*stroke:var\(--ink\)', panel.svg)
        assert [len(part.split()) for part in line.split("M")] == [0, 4, 4]

    def test_have_all_dots_of_a_trace_in_one_path(self):
        chart = one_chart([0.0, 1.0, np.nan, 0.5] * 100)
        dots = replace(chart.plots[0].traces[0], dots=True, width=2.2)
        panel = chart_panel(replace(chart, plots=[replace(chart.plots[0], traces=[dots])]))
        (path,) = re.findall(r'd="([^"]*)"[^>]*stroke:var\(--ink\)[^>]*linecap:round', panel.svg)
        ends = [part.split() for part in path.split("M")[1:]]
        assert len(ends) == 300 and all(dot[:2] == dot[2:] for dot in ends)

    def test_have_the_colours_of_the_page_and_no_id_twice(self, html):
        panel = chart_panel(one_chart([0.0, 1.0]))
        assert not re.search(r":#[0-9a-f]{6}|font-family|<style", panel.svg)
        ids = re.findall(r' id="([^"]*)"', html)
        assert len(set(ids)) == len(ids) > 50

    def test_do_not_depend_on_what_was_drawn_before(self):
        alone = chart_panel(one_chart([0.0, 1.0])).svg
        chart_panel(one_chart([-1e6, 5.0, 2e3]))
        assert chart_panel(one_chart([0.0, 1.0])).svg == alone

    def test_load_no_plotting_library_before_the_first(self):
        code = (
            "import sys, hil.report.interactive as i, hil.report.output_files; i.library();"
            " sys.exit(bool({'matplotlib', 'bokeh'} & {*sys.modules}))"
        )
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
