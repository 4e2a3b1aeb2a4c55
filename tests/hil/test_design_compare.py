"""Only what means the same is drawn side by side."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hil.cell import Cell
from hil.design import DesignResult, preset
from hil.design.result import references
from hil.design.run import DesignFolder, run_design
from hil.errors import InputError
from hil.progress import Silent
from sim_fixtures.ns16 import CELL_PATH

TINY = {"population": 8, "generations": 2, "polish": 0}


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(CELL_PATH)


@pytest.fixture(scope="module")
def result(cell, tmp_path_factory) -> DesignResult:
    folder = DesignFolder(tmp_path_factory.mktemp("design") / "a")
    settings = preset("a").kinematic().replaced(search=TINY)
    return run_design(folder, cell, settings, Silent(), workers=1).result


@pytest.fixture
def written(tmp_path):
    def written(result: DesignResult) -> Path:
        result.save(tmp_path / "excitation.toml")
        return tmp_path / "excitation.toml"

    return written


def changed(result: DesignResult, **tables: Any) -> DesignResult:
    return replace(result, data={**result.data, **tables})


def test_what_was_searched_without_looking_at_everything_is_marked(cell, result, written):
    path = written(result)
    found = references([path, path], cell, preset("b"), together=False)
    second = f"method A ({path})"
    measures = result.excitation.criteria.measures
    assert found.measures == {"method A": measures, second: measures}
    assert found.kinematic == {"method A", second}
    whole = changed(result, settings=preset("a").to_dict())
    assert references([written(whole)], cell, preset("b"), together=False).kinematic == set()


def test_another_robot_is_refused(cell, result, written):
    heavier = Cell.from_texts(
        cell.text.replace("gravity = [0.0, 0.0, -9.81]", "gravity = [0.0, 0.0, -1.62]"),
        cell.urdf,
        cell.path,
    )
    words = r"excitation\.toml: cell: was designed for the cell .*, whose robot is not that of"
    with pytest.raises(InputError, match=words):
        references([written(result)], heavier, preset("b"), together=False)


def test_what_adds_to_archives_is_not_drawn_beside_what_does_not(cell, result, written):
    archives = changed(result, earlier={"archives": [["a.mcap", "0" * 64]]})
    with pytest.raises(InputError, match=r"excitation\.toml: --compare: was designed with --earl"):
        references([written(archives)], cell, preset("b"), together=False)
    with pytest.raises(InputError, match=r"^--compare: .*--earlier.*leave out one of the two"):
        references([written(result)], cell, preset("b"), together=True)
    assert references([], cell, preset("b"), together=True).measures == {}


def test_other_parameters_are_not_drawn_beside_all(cell, result, written):
    names = list(cell.model.parameter_names)
    some = preset("b").replaced(objective={"parameters": names[:3]})
    words = r"excitation\.toml: --compare: was judged by 58 parameters, this design by 3, of which"
    with pytest.raises(InputError, match=words + " 3 are the same; .*same \\[objective\\]"):
        references([written(result)], cell, some, together=False)
    search = result.data["search"] | {"parameters": names[:3], "n_parameters": 3}
    subset = changed(result, search=search)
    assert references([written(subset)], cell, some, together=False).measures
    others = preset("b").replaced(objective={"parameters": names[1:4]})
    with pytest.raises(InputError, match="by 3 parameters, this design by 3, of which 2 are"):
        references([written(subset)], cell, others, together=False)
    everything = preset("b").replaced(objective={"parameters": names})
    assert references([written(result)], cell, everything, together=False).measures
