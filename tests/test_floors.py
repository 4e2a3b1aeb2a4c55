"""What a room of `hil` loads: who reads a file waits for no estimator and no search.

The floors themselves are a contract of import-linter in `pyproject.toml`.
"""

from __future__ import annotations

import pkgutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

import hil

ROOT = Path(hil.__file__).parent
ESTIMATION = ("estimators", "excitation", "export", "factor", "rollout", "selection", "validation")
"""Packages of `identification` above its model and its signals."""
PIPELINE = ("control", "design", "look", "pipeline", "report", "results")
IMPORTERS = sorted(path.stem for path in (ROOT / "importers").glob("[a-z]*.py"))


def loaded_by(*modules: str) -> set[str]:
    """Return the modules that a new process has loaded after some imports."""
    code = f"import sys, {', '.join(modules)}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


@pytest.mark.parametrize(
    "modules",
    [
        pytest.param(["hil.cell.cell"], id="the cell file"),
        pytest.param(["hil.importers.text_table"], id="a text table", marks=pytest.mark.long),
        pytest.param([f"hil.importers.{name}" for name in IMPORTERS], id="any log or bag"),
    ],
)
def test_reading_a_file_loads_neither_estimators_nor_searches(modules: list[str]) -> None:
    above = {f"identification.{name}" for name in ESTIMATION} | {f"hil.{name}" for name in PIPELINE}
    loaded = loaded_by(*modules)
    assert loaded >= {*modules}
    assert not above & loaded


def test_identification_knows_nothing_of_hil() -> None:
    assert not {name for name in loaded_by("identification.api") if name.startswith("hil")}


def test_a_look_loads_no_interpolator_recorder_or_export() -> None:
    loaded = loaded_by("hil.cli.look")
    assert "planner.limits" in loaded
    apart = {"planner.interpolator", "hil.archive.recorder", "identification.export.urdf"}
    assert not {"planner.api", "identification.api", *apart} & loaded


@pytest.mark.parametrize("package", ["planner", "identification"])
def test_a_name_that_is_imported_on_first_use_is_no_module(package: str) -> None:
    """Once the module is imported, the name would be the module."""
    modules = {module.name for module in pkgutil.iter_modules(import_module(package).__path__)}
    assert "api" in modules
    assert not modules & set(import_module(f"{package}.api").__all__)
