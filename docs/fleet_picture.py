"""Photograph the page of a fleet in headless Chromium: docs/fleet.png.

`python examples/08_fleet.py`, then `python docs/fleet_picture.py [runs/examples/fleet/trend.html]`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from report_picture import opened, save


def photograph(page_of_fleet: Path) -> None:
    """Write the picture of a page."""
    with opened(page_of_fleet, 860) as page:
        page.wait_for_timeout(500)
        save(page.screenshot(), "fleet.png")


if __name__ == "__main__":
    photograph(Path(sys.argv[1] if sys.argv[1:] else "runs/examples/fleet/trend.html"))
