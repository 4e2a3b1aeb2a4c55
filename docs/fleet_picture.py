"""Photograph the page of a fleet in headless Chromium: docs/fleet.png.

`python examples/08_fleet.py`, then `python docs/fleet_picture.py [runs/examples/fleet/trend.html]`.
"""

from __future__ import annotations

import shutil
import sys
from pathlib import Path

from playwright.sync_api import sync_playwright
from report_picture import save


def photograph(page_of_fleet: Path) -> None:
    """Write the picture of a page."""
    with sync_playwright() as driver:
        program = shutil.which("chromium") or shutil.which("google-chrome")
        browser = driver.chromium.launch(executable_path=program, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": 1280, "height": 860}, color_scheme="light")
        page.goto(page_of_fleet.resolve().as_uri())
        page.wait_for_timeout(500)
        save(page.screenshot(), "fleet.png")
        browser.close()


if __name__ == "__main__":
    photograph(Path(sys.argv[1] if sys.argv[1:] else "runs/examples/fleet/trend.html"))
