"""Photograph a report in headless Chromium: docs/report.png, and docs/report_zoom.png with values.

`make demo`, then `python docs/report_picture.py [runs/demo/report.html]`.
"""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from PIL import Image
from playwright.sync_api import sync_playwright

HERE: Final = Path(__file__).parent
DRAWN: Final = "() => hilCharts.find(group => group.name === 'torques')?.ready"
CHART: Final = '[data-chart="t1"] .plot-holder'


@contextmanager
def opened(page_of_hil: Path, height: int = 1010) -> Iterator[Any]:
    """Open a page that `hil` wrote in a window of headless Chromium."""
    with sync_playwright() as driver:
        program = shutil.which("chromium") or shutil.which("google-chrome")
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": height}, color_scheme="light")
        page.goto(page_of_hil.resolve().as_uri())
        yield page
        browser.close()


def save(photograph: bytes, name: str) -> None:
    """Write a picture beside this file with 256 colours, a third of the size."""
    picture = Image.open(io.BytesIO(photograph)).convert("RGB").quantize(256)
    picture.save(HERE / name, optimize=True)


def zoom(page: Any) -> None:
    """Drag over the middle of the second joint's plot, and point into it."""
    box = page.locator(CHART).first.bounding_box()
    middle = box["y"] + 0.5 * box["height"]
    page.mouse.move(box["x"] + 0.4 * box["width"], middle)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], middle, steps=8)
    page.mouse.up()
    page.mouse.move(box["x"] + 0.7 * box["width"], middle + 4.0)
    page.wait_for_timeout(800)


def photograph(report: Path) -> None:
    """Write both pictures of a report."""
    with opened(report) as page:
        page.wait_for_function(DRAWN)
        page.wait_for_timeout(800)
        save(page.screenshot(), "report.png")
        page.evaluate("document.getElementById('torque').scrollIntoView()")
        zoom(page)
        save(page.locator("#torque").screenshot(), "report_zoom.png")


if __name__ == "__main__":
    photograph(Path(sys.argv[1] if sys.argv[1:] else "runs/demo/report.html"))
