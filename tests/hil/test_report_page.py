"""What the page can do beyond being read: its one script, zoom, copying, how it was run."""

from __future__ import annotations

import base64
import hashlib
import html as html_module
import json
import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.report import render_report
from hil.report.drawing import FIRST, MOST_POINTS, Plot, Trace, traces_text
from hil.results import Results

from .test_report import HOSTILE, Page, assert_inert, make_results, make_series

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")


def conduct(**changes: Any) -> dict[str, Any]:
    """A campaign of two repetitions, one of them run twice, after a warm-up of three motions."""
    archive = {
        "kind": "excitation", "when": "2026-03-01T08:00:00+00:00", "seconds": 9.7, "cycles": 4870,
        "missed": 0, "late": 0, "not_accepted": 0, "lost": 0, "outcome": "completed", "why": "",
    }  # fmt: skip
    return {
        "steps": [
            {"step": "rehearsal", "done": True, "words": "6 of 6 criteria passed", "details": []},
            {"step": "dry run", "done": True, "words": "accepted by ada", "details": ["2 late"]},
        ],
        "warm_up": {
            "verdict": "warm",
            "threshold": 0.002,
            "friction": [[60.0 - k - j if j else None for j in range(6)] for k in range(3)],
            "change": [None, 0.02, 0.0015],
        },
        "recorded": [
            archive | {"archive": "excitation_000_a1.mcap", "missed": 3},
            archive
            | {"archive": "excitation_001_a1.mcap", "outcome": "rejected", "why": "it was held"},
            archive | {"archive": "excitation_001_a2.mcap"},
        ],
    } | changes


@pytest.fixture(scope="module")
def html() -> str:
    return render_report(make_results(conduct=conduct()), make_series())


@pytest.fixture(scope="module")
def page(html: str) -> Page:
    return Page(html)


def traces_in(html: str) -> list[dict[str, Any]]:
    return [json.loads(html_module.unescape(t)) for t in re.findall(r'data-traces="([^"]*)"', html)]


class TestOrder:
    """Verdict, errors, friction curves and parameters come first; figures of detail are folded."""

    def test_what_decides_stands_before_the_appendix(self, html: str) -> None:
        first = ["Torque error over all joints", 'id="judgement"', 'id="friction"',
                 'id="parameters"', 'id="trust"', '<details id="appendix">']  # fmt: skip
        folded = ['id="run"', 'id="excitation"', 'id="estimation"', 'id="residuals"',
                  'id="uncertainty"', 'id="correlation"', 'id="validation"']  # fmt: skip
        places = [html.index(mark) for mark in (*first, *folded) if mark in html]
        assert len(places) >= 10  # friction and judgement only where the results have them
        assert places == sorted(places)
        assert html.rindex("</details>") > places[-1]

    @pytest.mark.skipif(CHROMIUM is None, reason="needs chromium")
    def test_the_page_is_at_most_9000_pixels_high(self, html: str, tmp_path: Path) -> None:
        assert CHROMIUM is not None
        told = "<script>document.title = document.documentElement.scrollHeight</script></body>"
        text = re.sub(r"<meta http-equiv=[^>]*>", "", html).replace("</body>", told)
        (tmp_path / "page.html").write_text(text, encoding="utf-8")
        shown = subprocess.run(
            [CHROMIUM, "--headless", "--no-sandbox", "--window-size=1300,900", "--dump-dom",
             (tmp_path / "page.html").as_uri()],
            capture_output=True, text=True, timeout=120, check=True,
        ).stdout  # fmt: skip
        (height,) = re.findall(r"<title>(\d+)</title>", shown)
        assert 1000 < int(height) <= 9000


def test_a_reader_without_the_script_has_every_line_of_every_plot(html: str) -> None:
    svgs = re.findall(r"<svg[^>]*data-traces.*?</svg>", html, re.S)
    assert len(svgs) == 12
    assert all(svg.count("<path") > 4 for svg in svgs)
    assert "<button" not in html.replace(html[html.index("<script>") :], "")


def test_zoomed_in_the_samples_are_those_of_the_series(html: str) -> None:
    series = make_series()
    torque = traces_in(html)[6:]
    for j, content in enumerate(torque):
        assert content["end"] == pytest.approx(series.example_time[-1] - series.example_time[0])
        upper, lower = content["plots"]
        measured, predicted = (decoded(line) for line in upper["lines"])
        grid = np.linspace(0.0, content["end"], len(measured))
        time = series.example_time - series.example_time[0]
        for found, wanted in (
            (measured, series.example_measured[:, j]),
            (predicted, series.example_predicted[:, j]),
        ):
            step = np.ptp(wanted) / 65534.0
            np.testing.assert_allclose(found, np.interp(grid, time, wanted), atol=step)
        (error,) = (decoded(line) for line in lower["lines"])
        np.testing.assert_allclose(error, measured - predicted, atol=np.ptp(measured) / 20000.0)


def decoded(line: dict[str, Any]) -> np.ndarray:
    counts = np.frombuffer(base64.b64decode(line["data"]), "<u2")
    return np.asarray(line["low"] + line["step"] * counts)


@pytest.mark.parametrize("samples", [2, 100, 50_000])
def test_no_line_has_more_points_than_a_reader_can_use(samples: int) -> None:
    values = np.sin(np.arange(float(samples)))
    plot = Plot((0.0, 0.0, 1.0, 1.0), "x", [Trace(values, FIRST, 1.0, "x")])
    (content,) = json.loads(traces_text(np.arange(float(samples)), [plot]))["plots"]
    assert len(decoded(content["lines"][0])) == min(samples, MOST_POINTS)


def test_there_is_nothing_to_zoom_into_where_nothing_was_recorded() -> None:
    assert traces_text(np.zeros(1), []) == "" == traces_text(np.zeros(0), [])


def test_how_it_was_run_is_told_with_what_was_run_again_and_why(page: Page) -> None:
    text = page.text
    assert "How it was run" in text
    assert "6 of 6 criteria passed" in text and "Accepted by ada" in text and "2 late" in text
    assert "Repetition 2 ( excitation_001_a1.mcap ) rejected: it was held" in text
    assert "3 packets missed (205 in a million)" in text
    rows = page.table("Recorded as")
    assert [row["Outcome"] for row in rows] == ["completed", "▲ rejected", "completed"]
    assert [row["Missed"] for row in rows] == ["3", "0", "0"]
    assert "0.15 %, at most 0.2 % wanted" in text


def test_without_a_campaign_there_is_nothing_to_tell(page: Page) -> None:
    text = Page(render_report(make_results(), make_series())).text
    assert "How it was run" not in text
    quiet = conduct(warm_up=None, recorded=[])
    told = Page(render_report(make_results(conduct=quiet), make_series())).text
    assert "No archive could be read" in told and "Warm-up" not in told


def test_an_arm_that_did_not_get_warm_is_told_where_it_was_run(page: Page) -> None:
    cold = conduct()
    cold["warm_up"] |= {"verdict": "not warm"}
    words = {"done": False, "words": "not warm after 3 motions", "details": ["still 1.3% a motion"]}
    cold["steps"] = [{"step": "warm-up", **words}]
    text = Page(render_report(make_results(conduct=cold), make_series())).text
    assert "▲ Not warm after 3 motions" in text and "still 1.3% a motion" in text
    assert "the arm was not warm when the repetitions began" in text
    assert "not warm" not in page.text


def test_hostile_words_of_a_campaign_are_inert() -> None:
    spoilt = conduct()
    spoilt["steps"][0] |= {"words": HOSTILE, "details": [HOSTILE]}
    spoilt["recorded"][1] |= {"archive": HOSTILE, "why": HOSTILE, "when": HOSTILE, "kind": HOSTILE}
    page = Page(render_report(make_results(conduct=spoilt), make_series()))
    assert_inert(page)


def test_how_it_was_run_survives_results_json(tmp_path: Path) -> None:
    results = make_results(conduct=conduct())
    results.save(tmp_path / "results.json")
    assert Results.load(tmp_path / "results.json").conduct == results.conduct


DRIVER = """
const $ = (selector) => Array.from(document.querySelectorAll(selector));
addEventListener("load", () => {
  const said = {};
  said.copies = $("button.copy").length;
  said.captions = $("caption").length;
  document.execCommand = () => { said.copied = document.activeElement.value; return true; };
  Object.defineProperty(window, "isSecureContext", { value: false });
  $("button.copy")[0].click();
  const svg = $("svg[data-traces]")[6], box = svg.getBoundingClientRect();
  svg.setPointerCapture = () => {};
  const pointer = (kind, share) => svg.dispatchEvent(new PointerEvent(kind, { pointerId: 1,
    pointerType: "mouse", button: 0, bubbles: true, clientX: box.left + share * box.width }));
  pointer("pointerdown", 0.4); pointer("pointermove", 0.5); pointer("pointerup", 0.5);
  const figure = svg.closest("figure"), panels = svg.closest(".panels");
  const key = (name) => panels.dispatchEvent(new KeyboardEvent("keydown", { key: name }));
  setTimeout(() => {
    said.zoomed = figure.querySelectorAll("svg.zoomed").length;
    said.lines = figure.querySelectorAll("svg.zoomed .zoom-line").length;
    said.range = figure.querySelector(".zoom-bar span").textContent;
    key("0");
    setTimeout(() => {
      said.whole = figure.querySelectorAll("svg.zoomed").length;
      document.title = JSON.stringify(said);
    }, 200);
  }, 200);
});
"""


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs a browser: chromium")
def test_in_a_browser_tables_are_copied_and_plots_zoomed(html: str, tmp_path: Path) -> None:
    digest = base64.b64encode(hashlib.sha256(DRIVER.encode()).digest()).decode()
    driven = html.replace("script-src ", f"script-src 'sha256-{digest}' ", 1)
    path = tmp_path / "page.html"
    path.write_text(driven.replace("<script>", f"<script>{DRIVER}</script><script>", 1), "utf-8")
    assert CHROMIUM is not None
    command = [CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--virtual-time-budget=5000"]
    done = subprocess.run(
        [*command, path.as_uri()], capture_output=True, text=True, timeout=120, check=True
    )
    title = re.search(r"<title>(.*?)</title>", done.stdout, re.S)
    assert title is not None
    said = json.loads(html_module.unescape(title[1]))
    page = Page(html)
    assert said["copies"] == said["captions"] == len(page.tables)
    rows = [row.split("\t") for row in said["copied"].rstrip("\n").split("\n")]
    assert rows == [[" ".join(cell.split()) for cell in row] for row in page.tables[0]]
    assert said["zoomed"] == 6 and said["lines"] == 18 and said["whole"] == 0
    begin, end = (float(text) for text in re.findall(r"[\d.]+", said["range"]))
    assert 0.0 < begin < end < traces_in(html)[6]["end"] / 2.0 + 1.0
