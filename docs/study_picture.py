"""Photograph two figures of a study's report: docs/study_methods.png and docs/study_criteria.png.

`hil study --output runs/study`, then `python docs/study_picture.py [runs/study/report.html]`.
"""

from __future__ import annotations

import sys
from pathlib import Path

from report_picture import opened, save


def photograph(report: Path) -> None:
    """Write both pictures of a report."""
    with opened(report) as page:
        page.wait_for_timeout(800)
        save(page.locator("#methods figure").first.screenshot(), "study_methods.png")
        page.evaluate(
            "document.querySelectorAll('#criteria > :not(figure)').forEach(e => e.remove())"
        )
        save(page.locator("#criteria").screenshot(), "study_criteria.png")


if __name__ == "__main__":
    photograph(Path(sys.argv[1] if sys.argv[1:] else "runs/study/report.html"))
