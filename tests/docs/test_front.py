"""The files that a visitor of the repository opens first."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path

import pytest
import yaml

from tests.docs.typed import PAGES, ROOT

LONGEST_ROW = 400  # characters: a few lines of a table, not a screen
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def text(name: str) -> str:
    return (ROOT / name).read_text("utf-8")


VERSIONS = re.findall(r"^## (\S+)( \(unreleased\))?$", text("CHANGELOG.md"), re.MULTILINE)


@pytest.mark.parametrize("page", [*PAGES, ROOT / "ARCHITECTURE.md", ROOT / "CONTRIBUTING.md"],
                         ids=lambda page: page.name)  # fmt: skip
def test_no_row_of_a_table_fills_a_screen(page: Path) -> None:
    rows = [line for line in page.read_text("utf-8").splitlines() if line.startswith("|")]
    assert [row for row in rows if len(row) > LONGEST_ROW] == []


@pytest.mark.parametrize("page", ["README.md", "docs/index.md"])
def test_three_doors_lead_into_the_documentation(page: str) -> None:
    doors = re.findall(r"\[(I have[^\]]*)\]\((?:docs/)?([\w-]+\.md)\)", text(page))
    assert [name for name, _ in doors] == ["I have a log", "I have a COMAU", "I have no robot"]
    assert all((ROOT / "docs" / target).exists() for _, target in doors)


def test_the_changelog_tells_the_first_version_by_what_it_can_do() -> None:
    newest, _, first = text("CHANGELOG.md").partition("\n## 0.1.0\n")
    assert "\n## 0.2.0" in newest
    assert 0 < len(first.splitlines()) <= 40
    assert "Removed" not in first


def test_contributing_fits_on_two_pages_and_names_every_tier() -> None:
    page = text("CONTRIBUTING.md")
    assert len(page.splitlines()) <= 100
    for tier in ("make test`", "make test-safety`", "make test-all`", "make test-slow`"):
        assert tier in page


def test_the_version_is_that_at_the_top_of_the_changelog() -> None:
    number, unreleased = VERSIONS[0]
    assert PROJECT["version"] == (f"{number}.dev0" if unreleased else number)


def test_the_citation_is_of_the_newest_release_and_the_paper() -> None:
    citation = yaml.safe_load(text("CITATION.cff"))
    assert citation["version"] == next(number for number, unreleased in VERSIONS if not unreleased)
    assert citation["license"] == PROJECT["license"]
    (paper,) = citation["references"]
    assert paper["authors"][0]["family-names"] == "Villagrossi" and paper["year"] == 2014


def test_ci_runs_the_script_on_every_supported_python() -> None:
    (job,) = yaml.safe_load(text(".github/workflows/ci.yml"))["jobs"].values()
    assert job["strategy"]["matrix"]["python"] == ["3.11", "3.12", "3.13"]
    assert [step["run"] for step in job["steps"] if "run" in step] == [".ci/run"]
    assert os.access(ROOT / ".ci" / "run", os.X_OK)


@pytest.mark.parametrize("tool", ["ruff check", "ruff format", "mypy", "lint-imports"])
def test_pre_commit_runs_the_pinned_tools(tool: str) -> None:
    hooks = yaml.safe_load(text(".pre-commit-config.yaml"))["repos"][0]["hooks"]
    entries = " ".join(hook["entry"] for hook in hooks)
    assert f".venv/bin/{tool}" in entries
