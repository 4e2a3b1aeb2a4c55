"""Each script of examples/ runs, says what it does, and leaves its picture below runs."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLES = sorted((ROOT / "examples").glob("[0-9]*.py"))
PICTURES = ROOT / "examples" / "pictures"
SLOW = ("01", "03", "04", "06")
LAST_LINE = {
    "01": "report.html",
    "02": "completed",
    "03": "planted",
    "04": "The model",
    "05": "largest distance from the planned path",
    "06": "N·m",
    "07": "packets",
}  # Something that stands in what it prints


def code_lines(source: str) -> int:
    """Lines without blank ones, comments and docstrings."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            source = source.replace(f'"""{ast.get_docstring(node, clean=False)}"""', "")
    lines = source.splitlines()
    return sum(bool(line.strip()) and not line.lstrip().startswith("#") for line in lines)


def test_they_are_numbered_from_one() -> None:
    assert [path.name[:2] for path in EXAMPLES] == [f"{n:02d}" for n in range(1, 8)]


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_it_is_short_and_says_what_one_sees(path: Path) -> None:
    source = path.read_text("utf-8")
    assert "One sees" in (ast.get_docstring(ast.parse(source)) or "").replace("\n", " ")
    assert code_lines(source) <= 60
    assert (PICTURES / f"{path.stem}.png").is_file()


def test_the_pictures_are_small() -> None:
    assert sum(path.stat().st_size for path in PICTURES.iterdir()) < 1_000_000


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, marks=[pytest.mark.slow] if path.name[:2] in SLOW else [])
        for path in EXAMPLES
    ],
    ids=lambda path: path.stem,
)
def test_it_runs(path: Path, tmp_path: Path) -> None:
    # In a copy: pictures are for people to look at, and differ in nothing but time stamps.
    for name in ("sim_fixtures", "tests"):
        (tmp_path / name).symlink_to(ROOT / name)
    folder = tmp_path / "examples"
    folder.mkdir()
    (folder / "two_joints").symlink_to(ROOT / "examples" / "two_joints")
    script = folder / path.name
    script.write_text(path.read_text("utf-8"))
    quick = ["--quick"] if "--quick" in script.read_text("utf-8") else []
    done = subprocess.run(
        [sys.executable, str(script), *quick],
        cwd=tmp_path,
        env=os.environ | {"MPLBACKEND": "agg"},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert LAST_LINE[path.name[:2]] in done.stdout
    assert (tmp_path / "runs" / "examples" / f"{path.stem}.png").stat().st_size > 5_000
    assert sorted(one.name for one in folder.iterdir()) == sorted([path.name, "two_joints"])
