"""Photograph two figures of a study's report: docs/study_methods.png and docs/study_criteria.png.

`hil study --output runs/study`, then `python docs/study_picture.py [runs/study/report.html]`.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright
from report_picture import save


def photograph(report: Path) -> None:
    """Write both pictures of a report."""
    with sync_playwright() as driver:
        program = shutil.which("chromium") or shutil.which("google-chrome")
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 1010}, color_scheme="light")
        page.goto(report.resolve().as_uri())
        page.wait_for_timeout(800)
        save(page.locator("#methods figure").first.screenshot(), "study_methods.png")
        page.evaluate(
            "document.querySelectorAll('#criteria > :not(figure)').forEach(e => e.remove())"
        )
        save(page.locator("#criteria").screenshot(), "study_criteria.png")
        browser.close()


if __name__ == "__main__":
    photograph(Path(sys.argv[1] if sys.argv[1:] else "runs/study/report.html"))
