"""`make docs` as it is typed, and pages that need nothing from elsewhere."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages, built without a warning."""
    folder = tmp_path_factory.mktemp("pages")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", str(ROOT / "docs"), str(folder)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
def test_the_pages_need_no_network(built: Path) -> None:
    needs = re.compile(r'<(?:script|link|img)[^>]*(?:src|href)="(?:https?:)?//[^"]*"')
    for page in built.rglob("*.html"):
        assert not needs.findall(page.read_text("utf-8")), page.name
    for sheet in built.rglob("*.css"):
        assert not re.search(r"url\(\s*['\"]?(?:https?:)?//", sheet.read_text("utf-8")), sheet.name


@pytest.mark.slow
def test_formulae_are_mathml(built: Path) -> None:
    page = (built / "theory.html").read_text("utf-8")
    assert page.count("<math") > 20 and r"\boldsymbol" not in page
    assert "mathjax" not in page.lower().replace("mathjax_ignore", "")  # a class of sections


@pytest.mark.slow
def test_names_in_the_theory_lead_to_the_reference(built: Path) -> None:
    page = (built / "theory.html").read_text("utf-8")
    for name in ("identification.Regressor", "drivers.Session", "planner.TrajectoryPlayer"):
        assert re.search(rf'href="api-[^"]*#{re.escape(name)}[^"]*"[^>]*><code', page) or re.search(
            rf'href="api-[^"]*"[^>]*><code[^>]*><span class="pre">{re.escape(name)}', page
        ), name


@pytest.mark.slow
def test_the_reference_has_every_public_name(built: Path) -> None:
    import identification
    import planner

    for package in (planner, identification):
        page = (built / f"api-{package.__name__}.html").read_text("utf-8")
        missing = [
            name for name in package.__all__ if f'id="{package.__name__}.{name}"' not in page
        ]
        assert not missing
