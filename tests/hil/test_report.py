"""The report: one file, verdict first, safe against what archives are called."""

from __future__ import annotations

import base64
import csv
import hashlib
import io
import json
import math
import re
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from html.parser import HTMLParser
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.image import imread
from pydantic import ValidationError

from hil.report import (
    ReportSeries,
    SeriesError,
    csv_tables,
    numbers,
    render_report,
    report_bytes,
)
from hil.report.drawing import thinned
from hil.report.figures import correlation_matrix
from hil.report.page import joint_errors
from hil.results import Results
from sim_fixtures.ns16 import N_ESSENTIAL, TABLE2

JOINTS = [f"joint_{j}" for j in range(1, 7)]
TORQUE = np.array([496.0, 643.0, 158.0, 17.0, 23.0, 20.0])  # RMS of a fast motion, N·m


# fmt: off
def make_results(**changes: Any) -> Results:
    """The NS 16 as a campaign on the simulated cell would leave it; `changes` replace fields."""
    rng = np.random.default_rng(16)
    truth, size = np.array([row.pi_c or 0.0 for row in TABLE2]), len(TABLE2)
    std = (0.002 + 0.004 * np.abs(truth)) * rng.lognormal(0.0, 0.5, size)
    estimate = truth + std * rng.standard_normal(size)
    values = estimate + 5.0 * std * rng.standard_normal((30, size))
    inside = [int(np.sum(np.abs(estimate - truth) <= k * std)) for k in (2, 3)]
    fields: dict[str, Any] = {
        "name": "demo", "cell": "COMAU SMART NS 16-1.65", "simulated": True,
        "effects": ["gear ripple 0.5 %", "friction drift 3 % in 20 min", "delay 0.3 ms"],
        "joint_names": JOINTS, "period": 0.002,
        "software": {"hil": "0.1.0", "numpy": "2.4.6", "pinocchio": "4.1.0"},
        "excitation": {"duration": 14.85, "n_via": 6, "fly": 0.5,
                       "planned": _criteria(88.12, 118.4), "executed": _criteria(87.63, 119.2)},
        "estimator": {"name": "wls", "words": "weighted least squares (eq. 4)",
                      "prior": "nominal parameters to 10 %", "condition": 26.4,
                      "grouping": "40 of 66 standard parameters are independent."},
        "endogeneity": {"sentence": "Nothing says that noise has biased least squares.",
                        "biased": False, "statistic": 1.2, "p_value": 0.33,
                        "degrees_of_freedom": [6, 33], "noise": [0.001] * 6, "shifted": [],
                        "shift": [0.0] * size},
        "endogeneity_untested": None,
        "notes": ["the noise of the positions was measured at standstill"],
        "parameters": [
            {"name": row.pivot or row.parameter, "expression": row.parameter,
             "unit": _unit(row.pivot or row.parameter), "table2_id": row.id, "truth": truth[i],
             "estimate": estimate[i], "std": std[i], "repetition_mean": values[:, i].mean(),
             "repetition_std": values[:, i].std(ddof=1), "prior_std": 10.0 * std[i],
             "prior_ratio": 0.1, "learned": True}
            for i, row in enumerate(TABLE2)
        ],
        "n_base": N_ESSENTIAL,
        "uncertainty": {
            "reported": "phase_clustered", "phase_clustered": std,
            "method": "weighted least squares", "interval_factor": 2.05,
            "least_squares": std * rng.uniform(0.15, 0.4, size),
            "independent_repetitions": std * rng.uniform(0.5, 1.1, size),
            "scatter_of_mean": values.std(axis=0, ddof=1) / np.sqrt(30.0),
        },
        "repetitions": [f"excitation_{k:03d}_a1.mcap" for k in range(1, 31)],
        "repetition_values": values, "noise_std": 0.012 * TORQUE,
        "correlation": _correlation(rng, size),
        "validation": [_validation(rng, k) for k in range(1, 13)],
        "coverage": {"within_2": inside[0], "within_3": inside[1], "total": size},
        "verdict": {
            "good": True, "line": "The model predicts unseen motion to 1.5 % of the torque.",
            "reasons": ["Held-out error is 1.3 times the residual of the fit (allowed: 2).",
                        "52 of 58 parameters lie within two standard deviations of the truth."],
            "warnings": ["f2_1 is not distinct from zero."],
        },
    }
    plain = json.loads(json.dumps(fields | changes, default=lambda a: np.asarray(a).tolist()))
    return Results.model_validate(plain)


def real_recording() -> Results:
    """One imported recording: no truth, no plan, one way to a standard deviation, one run."""
    whole = make_results()
    unknown = {"truth": None, "table2_id": None, "repetition_std": None}
    none = dict.fromkeys(("independent_repetitions", "phase_clustered", "scatter_of_mean"))
    return make_results(
        simulated=False, effects=[], coverage=None, repetitions=["log.mcap"], endogeneity=None,
        endogeneity_untested="The recordings hold no commanded positions.", notes=[],
        excitation={"duration": 9.0, "n_via": None, "fly": None, "planned": None,
                    "executed": _criteria(70.0, 130.0)},
        parameters=[p.model_dump() | unknown for p in whole.parameters],
        uncertainty=whole.uncertainty.model_dump() | none | {"reported": "least_squares"},
        validation=[whole.validation[0].model_dump()],
        verdict={"good": False, "line": "Off by 24 %.", "reasons": [], "warnings": []},
    )


def _unit(name: str) -> str:
    units = {"m": "kg m", "I": "kg m²", "f0": "N·m", "f1": "N·m·s/rad", "f2": "N·m·s²/rad²"}
    return next(unit for start, unit in units.items() if name.startswith(start))


def _correlation(rng: np.random.Generator, size: int) -> np.ndarray:
    """Neighbours in the chain share what a motion shows of them."""
    shared = rng.uniform(0.0, 1.0, (size, 1)) * rng.standard_normal((15, 90))[np.arange(size) // 4]
    return np.corrcoef(rng.standard_normal((size, 90)) + 3.0 * shared)


def _criteria(log10_det: float, coupling: float) -> dict[str, float]:
    return {"log10_det": log10_det, "coupling_index": coupling, "coupling_index_max": 1653.0,
            "fitness": 0.7 * log10_det + 0.3 * 1653.0 / coupling, "n_samples": 7425,
            "condition": 48210.0, "scaled_condition": 96.4}


def _validation(rng: np.random.Generator, k: int) -> dict[str, Any]:
    rms = 0.016 * TORQUE * rng.lognormal(0.0, 0.2, 6)
    return {"archive": f"validation_{k:03d}_a1.mcap", "duration": 8.0 + k / 3.0,
            "mean_abs_error": 0.78 * rms, "rms_error": rms,
            "mean_error": 0.1 * rms * rng.standard_normal(6), "relative_error": rms / TORQUE,
            "all_rows_relative_error": 0.05,
            "overall_relative_error": float(np.linalg.norm(rms) / np.linalg.norm(TORQUE))}


def make_series(samples: int = 7425, joints: int = 6, name: str = "v.mcap") -> ReportSeries:
    """Smooth motion with the amplitudes of a real one, and a torque that is nearly right."""
    rng = np.random.default_rng(4)
    time, half = 0.002 * np.arange(samples), samples // 2
    rate, phase = rng.uniform(0.4, 2.6, (4, joints)), rng.uniform(0.0, 6.28, (4, joints))
    angle = rate * time[:, None, None] + phase
    position, velocity = 0.7 * np.sin(angle).sum(axis=1), 0.7 * (rate * np.cos(angle)).sum(axis=1)
    size = np.resize(TORQUE, joints)
    torque = size * (np.sin(position) + 0.3 * np.tanh(40.0 * velocity))
    noise = np.convolve(rng.standard_normal(samples), np.ones(9) / 3.0, "same")[:, None]
    measured = torque + 0.012 * size * noise
    return ReportSeries(time, position, velocity, name, time[:half], measured[:half], torque[:half])
# fmt: on


class Page(HTMLParser):
    """What a browser would make of a page, as far as these tests care."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.tables: list[list[list[str]]] = []
        self.words: list[str] = []
        self._in_cell = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in {"td", "th"}:
            self.tables[-1][-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag: str) -> None:
        self._in_cell = self._in_cell and tag not in {"td", "th"}

    def handle_data(self, data: str) -> None:
        if not self.tags or self.tags[-1][0] not in {"style", "script"}:
            self.words.append(data)
        if self._in_cell:
            self.tables[-1][-1][-1] += data

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def table(self, heading: str) -> list[dict[str, str]]:
        """Rows of the table that has a column `heading`, by column heading."""
        rows = next(rows for rows in self.tables if heading in rows[0])
        return [dict(zip(rows[0], row, strict=True)) for row in rows[1:] if len(row) > 1]


def assert_stands_alone(html: str) -> None:
    """The law of every page: nothing from outside, one script, ids and references that fit.

    The script is the one that the policy of the page names by its digest.
    """
    page = Page(html)
    assert not {"link", "iframe", "object", "embed"} & {tag for tag, _ in page.tags}
    assert [attributes for tag, attributes in page.tags if tag == "script"] == [{}]
    links = [a[key] for _, a in page.tags for key in a if key in {"src", "href", "xlink:href"}]
    assert all((link or "").startswith(("#", "data:image/png;base64,")) for link in links)
    assert "@import" not in html
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", html))
    (script,) = re.findall(r"<script>(.*?)</script>", html, re.S)
    policy = next(a["content"] or "" for t, a in page.tags if t == "meta" and "http-equiv" in a)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy.startswith("default-src 'none'") and f"script-src 'sha256-{digest}';" in policy
    assert "unsafe" not in policy.split("script-src")[1].split(";")[0]
    calls = r"eval\(|innerHTML|insertAdjacentHTML|https?:(?!//www\.w3\.org/2000/svg)"
    assert not re.findall(calls, script)
    ids = [a["id"] for _, a in page.tags if "id" in a]
    assert len(ids) == len(set(ids))
    assert set(re.findall(r'(?:href="|url\()#([^")]*)', html)) <= set(ids)


def assert_inert(page: Page) -> None:
    """Names from archives start nothing: the page's own script is the only one."""
    assert [tag for tag, _ in page.tags if tag in {"script", "img"}] == ["script"]
    assert not [name for _, a in page.tags for name in a if name.startswith("on")]


@pytest.fixture(scope="module")
def html() -> str:
    return render_report(make_results(), make_series())


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("noise_std", [1.0]),
        ("correlation", [[1.0]]),
        ("repetition_values", [[1.0]]),
        ("joint_names", ["one"]),
    ],
)
def test_lists_that_do_not_fit_are_no_results(field: str, value: object) -> None:
    with pytest.raises(ValidationError, match=r"has \d+ entries and not \d+"):
        make_results(**{field: value})


def test_the_verdict_comes_before_everything_else(html: str) -> None:
    line = html.index("predicts unseen motion to 1.5 % of the torque")
    assert line < html.index("SIMULATED") < html.index("What was run") < html.index("Figure 1")


@pytest.mark.parametrize(("good", "word"), [(True, "GOOD"), (False, "NOT GOOD")])
def test_the_verdict_is_a_word_and_a_symbol_not_only_a_colour(good: bool, word: str) -> None:
    verdict = {"good": good, "line": "So it is.", "reasons": ["because"], "warnings": []}
    text = render_report(make_results(verdict=verdict), make_series())
    card = text[text.index('<section class="verdict') :].split("</section>")[0]
    assert Page(card).text == f"{word} So it is. because"
    assert 'class="badge"' in card


def test_a_simulation_says_so_and_what_the_plant_did_besides(page: Page) -> None:
    assert "SIMULATED. No robot moved" in page.text
    assert all(effect in page.text for effect in make_results().effects)
    assert "best case" not in page.text
    ideal = Page(render_report(make_results(effects=[]), make_series()))
    assert "best case" in ideal.text


def test_a_real_recording_is_not_called_simulated_and_has_no_truth() -> None:
    page = Page(render_report(real_recording(), make_series()))
    assert not {"simulated", "truth:", "planned"} & set(page.text.lower().split())
    assert not any("Truth" in rows[0] for rows in page.tables)
    assert len(page.table("Estimate")) == 58


def test_the_report_stands_alone(html: str) -> None:
    assert_stands_alone(html)
    assert len(set(re.findall(r'(?:href="|url\()#([^")]*)', html))) > 50


def test_the_same_input_gives_the_same_bytes_whoever_draws(html: str) -> None:
    settings = {"lines.linestyle": ":", "svg.fonttype": "path", "text.usetex": True}
    with mpl.rc_context(settings), ThreadPoolExecutor(2) as pool:
        pages = list(pool.map(lambda _: report_bytes(make_results(), make_series()), range(2)))
        assert {key: mpl.rcParams[key] for key in settings} == settings
    assert set(pages) == {html.encode()}


def test_a_full_campaign_stays_small() -> None:
    runs = [make_results().validation[0].model_dump() for _ in range(30)]
    text = render_report(make_results(validation=runs), make_series(samples=40_000))
    assert len(text.encode()) < 1_500_000


HOSTILE = '$\\frac$\x07"><script>alert(1)</script><img src=x onerror=alert(2)>--></svg>{{7*7}}'


def test_names_from_archives_are_inert() -> None:
    def spoil(value: Any) -> Any:
        if isinstance(value, list):
            return [spoil(v) for v in value]
        if isinstance(value, dict):
            end = HOSTILE if "hil" in value else ""  # the keys of `software` are names too
            return {k + end: spoil(v) for k, v in value.items()}
        # The route is one of four words: nothing else gets past the schema.
        hostile = isinstance(value, str) and value != "phase_clustered"
        return value + HOSTILE if hostile else value

    spoilt = Results.model_validate(spoil(make_results().model_dump()))
    page = Page(render_report(spoilt, make_series(name="v" + HOSTILE)))
    assert_inert(page)
    assert "{{7*7}}" in page.text
    assert "<script>alert(1)</script>" in page.text


def test_the_parameter_table_holds_the_numbers(page: Page) -> None:
    rows = page.table("Estimate")
    parameters = make_results().parameters
    assert [row["Id"] for row in rows] == [str(p.table2_id) for p in parameters]
    for row, p in zip(rows, parameters, strict=True):
        half = 0.06 * p.std  # numbers are rounded at the second digit of std
        assert float(row["Estimate"]) == pytest.approx(p.estimate, abs=half)
        assert float(row["Truth"]) == pytest.approx(p.truth, abs=half)
        assert float(row["± std"]) == pytest.approx(p.std, rel=0.06)
        assert float(row["95 % from"]) == pytest.approx(p.estimate - 2.05 * p.std, abs=half)
        assert float(row["95 % to"]) == pytest.approx(p.estimate + 2.05 * p.std, abs=half)
        z = (p.estimate - p.truth) / p.std
        assert float(row["(est. − truth) / std"]) == pytest.approx(z, abs=0.0051)
        assert float(row["Std over rep."]) == pytest.approx(p.repetition_std, rel=0.06)


def test_estimates_that_are_off_or_not_significant_are_marked() -> None:
    cases = [
        (10.0, 8.1, ""), (10.0, 7.9, "▲ outside 2σ"), (10.0, 13.1, "■ outside 3σ"),
        (1.9, 1.0, "○ not significant"), (1.9, 5.0, "■ outside 3σ, ○ not significant"),
    ]  # fmt: skip
    parameters = [p.model_dump() for p in make_results().parameters]
    for parameter, (estimate, truth, _) in zip(parameters, cases, strict=False):
        parameter |= {"estimate": estimate, "truth": truth, "std": 1.0}
    page = Page(render_report(make_results(parameters=parameters), make_series()))
    remarks = [row["Remark"].replace("\xa0", " ") for row in page.table("Estimate")]
    assert remarks[: len(cases)] == [remark for *_, remark in cases]


def test_the_page_says_which_route_is_reported_and_what_each_would_have_covered(page: Page) -> None:
    rows, results = {row["Route"]: row for row in page.table("Route")}, make_results()
    assert [name.endswith("(reported)") for name in rows] == [False, False, True, False]
    pairs = zip(results.parameters, results.uncertainty.least_squares, strict=True)
    inside = sum(abs(p.estimate - p.truth) <= 2.0 * std for p, std in pairs)
    assert rows["Least squares"]["Truth within 2σ"] == f"{inside} of 58"


def test_the_correlation_matrix_is_shaded_from_white_to_black_without_friction() -> None:
    results = make_results()
    image = re.findall(r"data:image/png;base64,([^\"]*)", correlation_matrix(results).svg)[0]
    pixels = imread(io.BytesIO(base64.b64decode(image)))[..., :3]
    assert pixels.shape == (40, 40, 3)
    expected = np.abs(np.array(results.correlation)[:40, :40])
    np.testing.assert_allclose(1.0 - pixels.mean(axis=2), expected, atol=0.02)


def test_errors_over_runs_are_those_of_all_their_samples() -> None:
    rng = np.random.default_rng(1)
    errors = [scale * rng.standard_normal((size, 6)) for scale, size in ((1.0, 400), (3.0, 100))]
    keys = ("duration", "rms_error", "mean_error")
    found = [(0.01 * len(e), (e**2).mean(axis=0) ** 0.5, e.mean(axis=0)) for e in errors]
    runs = [_validation(rng, 1) | dict(zip(keys, values, strict=True)) for values in found]
    every = np.concatenate(errors)
    for j, row in enumerate(joint_errors(make_results(validation=runs))):
        assert row["rms"] == pytest.approx(math.sqrt((every[:, j] ** 2).mean()))
        assert row["mean"] == pytest.approx(every[:, j].mean())


def test_every_run_and_joint_stands_in_the_tables_with_names_whole(page: Page) -> None:
    results = make_results()
    tables = [rows for rows in page.tables if rows[0][0] == "Archive"]
    assert len(tables) == 4
    for rows in tables:
        assert [row[0] for row in rows[1:]] == [run.archive for run in results.validation]
    third, fifth = results.validation[2], results.validation[4]
    assert float(tables[2][3][2 + 4]) == pytest.approx(third.mean_error[4], abs=6e-4)
    assert float(tables[3][5][-1]) == pytest.approx(100.0 * fifth.overall_relative_error, rel=0.006)


def test_a_reader_who_cannot_see_is_told_what_each_figure_shows(page: Page, html: str) -> None:
    figures = [a for tag, a in page.tags if tag == "svg" and a.get("role") == "img"]
    assert len(figures) == 6 + 3 + 1 + 6 + 6
    assert all(len(a["aria-label"] or "") > 30 for a in figures)
    assert sum(tag == "h1" for tag, _ in page.tags) == 1
    assert sum(tag == "caption" for tag, _ in page.tags) == len(page.tables)
    for kind, count in (("Figure", 5), ("Table", 10)):
        found = re.findall(rf"<b>{kind} (\d+)\.</b>", html)
        assert found == [str(k) for k in range(1, count + 1)]


def test_figures_take_every_colour_from_the_style_sheet(html: str) -> None:
    drawn = html[html.index("<main>") :]
    assert not re.findall(r"(?:fill|stroke): *#[0-9a-f]{3,6}", drawn)
    declared = set(re.findall(r"(--[a-z0-9-]+):", html))
    assert set(re.findall(r"var\((--[a-z0-9-]+)\)", html)) <= declared


def test_an_arm_of_one_joint_without_friction_or_validation_has_a_report_too() -> None:
    whole, series, empty = real_recording(), make_series(joints=1), np.empty((0, 1))
    executed = _criteria(1.0, 1.0) | {"condition": math.inf}
    # fmt: off
    alone = whole.model_dump() | {
        "joint_names": ["q"], "parameters": [whole.parameters[5].model_dump()], "n_base": 1,
        "correlation": [[1.0]], "noise_std": [0.1], "validation": [], "fitted": None,
        "repetition_values": [[1.0] for _ in whole.repetitions],
        "uncertainty": whole.uncertainty.model_dump() | {"least_squares": [math.nan]},
        "excitation": whole.excitation.model_dump() | {"executed": executed},
    }
    # fmt: on
    none = {"example_time": empty[:, 0], "example_measured": empty, "example_predicted": empty}
    page = Page(render_report(Results.model_validate(alone), replace(series, **none)))
    assert "Nothing was held out" in page.text


def test_it_says_how_the_estimate_was_made_and_what_stands_behind_it(page: Page) -> None:
    results = make_results()
    assert results.estimator.words in page.text
    assert results.estimator.grouping in page.text
    assert results.notes[0] in page.text
    assert results.endogeneity is not None
    assert results.endogeneity.sentence in page.text
    size = len(results.parameters)
    assert f"{size} of {size} parameters were learned from the data" in page.text


def test_what_was_not_tested_or_believed_is_said_too() -> None:
    estimator = make_results().estimator.model_dump() | {"prior": "the URDF gives no inertia"}
    parameters = [p.model_dump() | {"learned": None} for p in real_recording().parameters]
    recording = real_recording().model_copy(
        update={"estimator": make_results(estimator=estimator).estimator,
                "parameters": make_results(parameters=parameters).parameters}
    )  # fmt: skip
    text = Page(render_report(recording, make_series())).text
    assert "The recordings hold no commanded positions." in text
    assert "Nothing: the URDF gives no inertia." in text


def test_the_posterior_takes_the_place_of_the_phase_clustered_route() -> None:
    uncertainty = make_results().uncertainty.model_dump()
    std = uncertainty["phase_clustered"]
    changed = uncertainty | {"phase_clustered": None, "posterior": std, "reported": "posterior"}
    page = Page(render_report(make_results(uncertainty=changed), make_series()))
    assert "Posterior (reported)" in page.text
    assert "Phase-clustered" not in page.text


def test_series_that_do_not_belong_together_are_refused_by_name() -> None:
    good = make_series()
    with pytest.raises(SeriesError, match="excitation_velocity") as caught:
        replace(good, excitation_velocity=good.excitation_velocity[:-1])
    assert caught.value.expected == (7425, 6)
    with pytest.raises(SeriesError):
        render_report(make_results(), make_series(joints=5))


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=3000), st.integers(1, 200))
def test_thinning_keeps_order_ends_and_every_peak(values: list[float], bins: int) -> None:
    time, signal = np.arange(float(len(values))), np.array(values)
    kept_time, kept = thinned(time, signal, bins)
    assert kept.size <= 2 * bins + 2
    assert np.all(np.diff(kept_time) > 0)
    assert (kept_time[0], kept_time[-1]) == (time[0], time[-1])
    assert (kept.min(), kept.max()) == (signal.min(), signal.max())


@given(st.floats(-1e12, 1e12), st.floats(1e-12, 1e9))
def test_numbers_read_back_as_what_they_were(value: float, std: float) -> None:
    assert float(numbers.significant(value)) == pytest.approx(value, rel=0.0051)
    assert abs(float(numbers.beside(value, std)) - value) <= 0.06 * std + 1e-9 * abs(value)


def test_a_number_is_rounded_where_its_uncertainty_begins() -> None:
    assert numbers.beside(71.6987, 0.4512) == "71.70"
    assert numbers.beside(71.6987, 31.0) == "72"
    assert numbers.beside(9.996, 0.0996) == "10.00"
    assert numbers.beside(-0.00004, 0.02) == "0.000"
    assert numbers.beside(1.23456e-9, 2.2e-11) == "1.235e-9"
    assert numbers.beside(5.0, math.nan) == "5.000"


class TestTables:
    """Every list of records and every matrix is a CSV file with the numbers of `results.json`."""

    def rows(self, name: str) -> list[dict[str, str]]:
        return list(csv.DictReader(io.StringIO(csv_tables(make_results())[name])))

    def test_a_record_is_a_row_in_full_precision(self) -> None:
        found, results = self.rows("parameters.csv"), make_results()
        assert [row["name"] for row in found] == [p.name for p in results.parameters]
        assert [float(row["estimate"]) for row in found] == [p.estimate for p in results.parameters]

    def test_numbers_of_joints_have_a_column_each(self) -> None:
        run, row = make_results().validation[0], self.rows("validation.csv")[0]
        assert [float(row[f"rms_error.{joint}"]) for joint in JOINTS] == list(run.rms_error)

    def test_a_matrix_has_a_column_per_parameter(self) -> None:
        results = make_results()
        found = self.rows("repetition_values.csv")
        assert list(found[0]) == [p.name for p in results.parameters]
        assert [float(x) for x in found[-1].values()] == list(results.repetition_values[-1])
