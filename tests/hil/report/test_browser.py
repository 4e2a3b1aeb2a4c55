"""The report in a browser: charts that a person drags, paper, and the page without its script."""

from __future__ import annotations

import pytest

from hil.report.page import report_bytes
from tests.hil.browser import OpenedPage, chromium, page_count
from tests.hil.report.pages import JOINTS, make_results, make_series, with_joints

# The process of the browser's driver warns at its end.
pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("ignore::ResourceWarning")]
VIEWS = {"torques": "#view-torque", "parts": "#view-parts", "spectra": "#view-spectra"}


@pytest.fixture(scope="module")
def browser():
    with chromium() as program:
        yield program


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    path.write_bytes(report_bytes(make_results(), make_series(samples=3000)))
    return path


@pytest.fixture
def opened(browser, path):
    page = OpenedPage(browser, path)
    wait_for(page.page, "torques")
    yield page
    page.close()
    assert page.errors == []


def wait_for(page, group):
    """Wait until the script has drawn the charts of a figure."""
    page.locator(f'figure[data-charts="{group}"]').scroll_into_view_if_needed()
    page.wait_for_function(
        "name => window.hilCharts.some(group => group.name === name && group.ready)", arg=group
    )
    page.wait_for_timeout(300)


def x_ranges(page, group="torques"):
    """Horizontal ranges of all charts of a figure."""
    return page.evaluate(
        """name => hilCharts.find(group => group.name === name).views
           .map(view => [view.shared.range.start, view.shared.range.end])""",
        group,
    )


def heights(page, group="torques"):
    return page.evaluate(
        """name => hilCharts.find(group => group.name === name).views
           .map(view => view.y.end - view.y.start)""",
        group,
    )


def colours_of(canvas):
    return canvas.evaluate(
        """canvas => new Set(new Uint32Array(canvas.getContext("2d").getImageData(
           0, 0, canvas.width, canvas.height).data.buffer)).size"""
    )


def drag(page, chart, start, end):
    """Drag from one share of the width of a chart's upper plot to another."""
    box = page.locator(f'[data-chart="{chart}"] .plot-holder').first.bounding_box()
    row = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + start * box["width"], row)
    page.mouse.down()
    page.mouse.move(box["x"] + end * box["width"], row, steps=8)
    page.mouse.up()
    page.wait_for_timeout(300)


class TestCharts:
    def test_are_all_drawn_with_a_text_alternative(self, opened):
        page = opened.page
        page.evaluate("document.getElementById('appendix').open = true")
        for group in (*VIEWS, "friction", "excitation"):
            if group in VIEWS:
                page.locator(f"label:has({VIEWS[group]})").click()
            wait_for(page, group)
            panels = page.locator(f'figure[data-charts="{group}"] .panel.interactive')
            assert panels.count() == len(JOINTS)
            for panel, joint in zip(panels.all(), JOINTS, strict=True):
                assert panel.locator(".live").get_attribute("aria-label").startswith(joint)
                for plot in panel.locator(".plot-holder").all():
                    # Layers of a plot: lines below, what moves with the pointer above.
                    assert max(map(colours_of, plot.locator("canvas").all())) > 5

    def test_show_the_verdict_and_curves_on_the_first_screen(self, opened):
        boxes = [
            opened.page.locator(selector).first.bounding_box()
            for selector in (".verdict", '[data-chart="t0"] .plot-holder')
        ]
        assert boxes[0]["y"] < boxes[1]["y"]
        assert boxes[1]["y"] + boxes[1]["height"] < 900

    def test_zoom_together_and_back(self, opened):
        page = opened.page
        before = x_ranges(opened.page)
        drag(page, "t0", 0.4, 0.6)
        zoomed = x_ranges(page)
        assert zoomed[0][0] > before[0][0] and zoomed[0][1] < before[0][1]
        assert all(x_range == zoomed[0] for x_range in zoomed) and len(zoomed) == 2 * len(JOINTS)
        page.locator("label:has(#view-parts)").click()
        wait_for(page, "parts")
        assert x_ranges(page, "parts")[0] == pytest.approx(zoomed[0])
        page.get_by_role("button", name="Whole range").locator("visible=true").first.click()
        page.wait_for_timeout(300)
        assert x_ranges(page) == before

    def test_pan_when_dragged_so(self, opened):
        page = opened.page
        drag(page, "t0", 0.4, 0.6)
        zoomed = x_ranges(page)[0]
        page.get_by_role("button", name="Drag: pan").locator("visible=true").first.click()
        drag(page, "t3", 0.5, 0.7)
        moved = x_ranges(page)[0]
        assert moved[0] < zoomed[0]
        assert moved[1] - moved[0] == pytest.approx(zoomed[1] - zoomed[0])

    def test_leave_the_wheel_to_the_page_unless_ctrl_is_held(self, opened):
        page = opened.page
        before = x_ranges(opened.page)
        page.locator('[data-chart="t0"] .plot-holder').first.hover()
        page.mouse.wheel(0, 120)
        page.wait_for_timeout(300)
        assert page.evaluate("window.scrollY") > 0 and x_ranges(page) == before
        page.locator('[data-chart="t0"] .plot-holder').first.hover()
        page.keyboard.down("Control")
        page.mouse.wheel(0, -120)
        page.keyboard.up("Control")
        page.wait_for_timeout(300)
        assert x_ranges(page) != before

    def test_show_values_at_the_pointer(self, opened):
        page = opened.page
        page.locator('[data-chart="t1"] .plot-holder').first.hover()
        tooltip = page.locator(".bk-Tooltip").first
        tooltip.wait_for(timeout=5000)
        text = tooltip.evaluate("tooltip => tooltip.shadowRoot.textContent")
        assert all(word in text for word in ("time", "measured", "nominal", "predicted", "N·m"))

    def test_hide_joints_and_lines(self, opened):
        page = opened.page
        before = heights(opened.page)
        page.get_by_role("button", name="joint_2", exact=True).locator("visible=true").first.click()
        assert not page.locator('[data-chart="t1"]').is_visible()
        assert not page.locator('[data-chart="k1"]').is_visible()
        assert page.locator('[data-chart="t2"]').is_visible()
        page.get_by_role("button", name="nominal model").first.click()
        page.wait_for_timeout(200)
        assert heights(page)[1] < 0.5 * before[1]  # the error alone fills its plot


class TestPage:
    @pytest.mark.parametrize("width", [1200, 800, 380])
    def test_does_not_scroll_sideways(self, browser, tmp_path, width):
        """Not with every column of the table of parameters; on narrow pages tables scroll alone."""
        parameters = [p.model_dump() for p in make_results().parameters]
        for parameter in parameters:
            parameter |= {"prior_std": 1.0, "prior_ratio": 0.5, "unit": "N·m·s²/rad²"}
            parameter |= {"estimate": -3.2e-5, "std": 4.2e-5, "truth": -1.17e-4}
            parameter |= {"repetition_mean": -3.1e-5, "repetition_std": 1.8e-4}
            parameter |= {"expression": "I3xx - I3zz + I4zz - 0.034225 m4 + 0.355151 m5"}
        results = make_results(parameters=parameters)
        path = tmp_path / "report.html"
        path.write_bytes(report_bytes(results, make_series(samples=300)))
        opened = OpenedPage(browser, path)
        page = opened.page
        page.evaluate("document.querySelectorAll('details').forEach(part => part.open = true)")
        page.set_viewport_size({"width": width, "height": 900})
        page.wait_for_timeout(200)
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        opened.close()


class TestWithoutScript:
    def test_has_the_pictures_and_the_views(self, browser, path):
        opened = OpenedPage(browser, path, java_script_enabled=False)
        page = opened.page
        assert page.locator('[data-chart="t0"] > svg').is_visible()
        assert page.locator(".live, .tools").count() == 0
        assert not page.locator('[data-chart="f0"] > svg').is_visible()
        page.locator("label:has(#view-spectra)").click()
        assert page.locator('[data-chart="f0"] > svg').is_visible()
        assert not page.locator('[data-chart="t0"] > svg').is_visible()
        opened.close()
        assert opened.errors == []


class TestPaper:
    def test_has_the_pictures_of_the_chosen_view_and_no_controls(self, opened):
        page = opened.page
        page.emulate_media(media="print")
        for chart in ("t0", "k0"):
            assert page.locator(f'[data-chart="{chart}"] > svg').is_visible()
        assert not page.locator(".live, .tools, .tabs").locator("visible=true").count()

    def test_has_six_sheets_at_most(self, opened):
        assert page_count(opened.page.pdf(prefer_css_page_size=True)) <= 6

    @pytest.mark.parametrize("joints", [1, 6, 7, 12, 15])
    def test_of_the_summary_is_one_sheet(self, browser, tmp_path, joints):
        reasons = [f"axis {k} is off by more than it may be" for k in range(4)]
        verdict = {"good": False, "line": "The model must not be relied on: " + 3 * reasons[0],
                   "reasons": reasons, "warnings": 9 * ["friction drifts"]}  # fmt: skip
        occasion = {"recorded_from": "2026-11-02T08:15:30Z", "operator": "ada", "notes": "wet",
                    "identified_at": "2026-11-26T12:30:04Z", "serial_number": "4711"}  # fmt: skip
        results = with_joints(make_results(verdict=verdict, occasion=occasion), joints)
        path = tmp_path / "report.html"
        path.write_bytes(report_bytes(results, make_series(joints=joints)))
        opened = OpenedPage(browser, path, "#summary")
        page = opened.page
        assert page_count(page.pdf(prefer_css_page_size=True)) == 1
        page.emulate_media(media="print")
        for selector in (".verdict", ".occasion", f'[data-chart="t{joints - 1}"] > svg',
                         'th:text-is("R²")'):  # fmt: skip
            assert page.locator(selector).first.is_visible()
        assert not page.locator("#parameters").is_visible()
        opened.close()
        assert opened.errors == []
