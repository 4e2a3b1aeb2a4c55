from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.cell import Cell
from hil.design import DesignResult, load_design, preset, problem_of
from hil.design.result import _seal, fingerprint, references
from hil.design.run import Designed, DesignFolder, run_design
from hil.errors import InputError
from hil.progress import Silent
from identification.excitation import Objective
from planner import FourierSeries
from sim_fixtures.ns16 import CELL_PATH

TINY = {"population": 8, "generations": 2, "polish": 0}


@pytest.fixture(scope="module")
def cell() -> Cell:
    return Cell.load(CELL_PATH)


@pytest.fixture(scope="module", params=["a", "b"])
def made(request, cell, tmp_path_factory) -> tuple[DesignFolder, Designed]:
    folder = DesignFolder(tmp_path_factory.mktemp("design") / request.param)
    settings = preset(request.param).kinematic().replaced(search=TINY)
    return folder, run_design(folder, cell, settings, Silent(), workers=1)


@pytest.fixture
def text(made) -> str:
    return made[0].result.read_text()


def written(folder, text):
    path = folder / "excitation.toml"
    path.write_text(text)
    return path


def test_the_file_restores_everything(made, cell):
    folder, done = made
    again = DesignResult.load(folder.result)
    assert again.excitation.to_dict() == done.design.excitation.to_dict()
    assert load_design(folder.root, cell).to_dict() == again.excitation.to_dict()
    assert again.settings == done.result.settings and again.complete
    front = again.data["front"]
    assert front["chosen"] == done.design.chosen
    for name in ("log10_det", "coupling_index"):
        np.testing.assert_array_equal(front[name], done.design.front.measure(name))
    search = again.data["search"]
    assert (search["generations"], search["n_parameters"]) == (2, 58)
    assert again.data["software"] == done.result.data["software"]
    assert {"hil", "ruckig", "pymoo", "cma", "numpy"} <= again.data["software"].keys()
    assert "polished_from" not in again.data


def test_its_criteria_are_those_of_the_motion_at_a_millisecond(made, cell):
    excitation = load_design(made[0].result)
    again = Objective(cell.model).criteria(excitation.trajectory, 0.001)
    assert again == excitation.criteria
    assert excitation.criteria.n_samples == pytest.approx(
        1000 * excitation.trajectory.duration, abs=2
    )
    assert excitation.criteria.condition is not None
    assert excitation.criteria.scaled_condition is not None


def test_a_motion_through_via_points_shows_its_moves_and_sines_their_amplitudes(made, text):
    sines = isinstance(made[1].design.excitation.trajectory, FourierSeries)
    assert len(text) < 20_000 and "coupling_index_max = 1653.0" in text
    assert ("amplitude_deg" in text) == sines
    assert ("[[plan.moves]]" in text) == ("target_deg" in text) == (not sines)


def test_a_motion_that_was_changed_is_refused(made, text, tmp_path):
    sines = "amplitude_deg" in text
    for name in ("amplitude_deg" if sines else "target_deg", "coupling_index"):
        last = rf"({name} = \[+-?[\d.]*)(\d)"  # digit of the first number of a list
        new, count = re.subn(last, lambda m: f"{m[1]}{(int(m[2]) + 1) % 10}", text, count=1)
        assert count == 1
        with pytest.raises(InputError, match=r"excitation\.toml: was changed after.*restore it"):
            load_design(written(tmp_path, new))


def resealed(text: str) -> str:
    """The text with the seal that belongs to what it says now."""
    new, count = re.subn(r'(?m)^sha256 = "\w+"', f'sha256 = "{_seal(text)}"', text)
    assert count == 1
    return new


@pytest.mark.parametrize(
    "line",
    [
        *('coupling_index = "59"', "fitness = true", "n_samples = 20001.0", "condition = [1.0]"),
        *('seed = "1"', "method = 3", "complete = 1"),
    ],
)
def test_figures_that_are_none_are_refused(text, tmp_path, line):
    """Even with the seal that belongs to them."""
    changed, count = re.subn(rf"(?m)^{line.partition(' ')[0]} = .*$", line, text, count=1)
    assert count == 1
    with pytest.raises(InputError, match=r"excitation\.toml: .*design it again"):
        load_design(written(tmp_path, resealed(changed)))


def test_comments_and_blank_lines_may_be_changed(text, tmp_path, made):
    path = written(tmp_path, "# mine\n\n" + re.sub(r"(?m)^#.*\n", "", text))
    assert load_design(path).to_dict() == made[1].design.excitation.to_dict()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('format = "designed excitation"', 'format = "joint motion plan"', "format is"),
        ("version = 1", "version = 2", "version is 2, this reads 1"),
        ("[seal]", "[seals]", "'seal'"),
        ("[criteria]", "[criteria", "not a designed excitation"),
    ],
)
def test_another_file_is_refused(text, tmp_path, old, new, words):
    with pytest.raises(InputError, match=words) as caught:
        load_design(written(tmp_path, text.replace(old, new, 1)))
    assert "design it again" in str(caught.value)


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(InputError, match=r"excitation\.toml: cannot be read"):
        load_design(tmp_path)


def test_another_planner_may_differ_in_the_last_digits_and_no_more(made, text, tmp_path):
    other = re.sub(r'motion_sha256 = "\w+"', 'motion_sha256 = "0"', text)
    assert load_design(written(tmp_path, other)).to_dict() == made[1].design.excitation.to_dict()
    elsewhere = re.sub(r"(positions_deg = \[\[)[^,]+", r"\g<1>45.0", other)
    with pytest.raises(InputError, match="do not plan to the motion that was designed"):
        load_design(written(tmp_path, elsewhere))
    for nothing in ('"x"', "{ a = 1 }", "2026-11-21", "[[1.0], [2.0, 3.0]]"):
        odd = re.sub(r"positions_deg = \[\[.*\]\]", f"positions = {nothing}", other, flags=re.S)
        assert odd != other
        with pytest.raises(InputError, match="is not a designed excitation"):
            load_design(written(tmp_path, odd))


def test_a_cell_with_other_limits_is_refused_by_name(made, cell):
    slow = [100.0, 155.0, 170.0, 360.0, 350.0, 550.0]
    other = cell.with_values({"limits.velocity_deg": slow, "cell.name": "the slow one"})
    with pytest.raises(InputError) as caught:
        load_design(made[0].result, other)
    for word in ("'NS 16 (simulated)'", "'the slow one'", "limits"):
        assert word in str(caught.value)


def test_a_cell_with_another_campaign_link_or_wall_is_the_same_robot(made, cell):
    other = cell.with_campaign(repetitions=3).with_link(transport="udp", host="127.0.0.1")
    respelled = other.text.replace("margin = 0.05", "margin = 5e-2  # m")
    assert respelled != other.text
    other = Cell.from_texts(respelled, cell.urdf, cell.path)
    assert fingerprint(other) == fingerprint(cell)
    wall = {"lower": [2.0, 2.0, 0.0], "upper": [2.1, 2.1, 1.0]}
    walled = cell.with_values({"workspace.walls": [wall]})
    assert fingerprint(walled) != fingerprint(cell)
    for each in (other, walled):
        load_design(made[0].result, each)


def test_a_subset_and_a_polish_are_recorded(cell, tmp_path):
    names = list(cell.model.parameter_names[:12])
    settings = preset("front").kinematic()
    settings = settings.replaced(search=TINY | {"polish": 80}, objective={"parameters": names})
    folder = DesignFolder(tmp_path / "few")
    design = run_design(folder, cell, settings, Silent(), workers=2).design
    again = DesignResult.load(folder.result)
    assert again.data["search"]["parameters"] == names
    assert again.data["search"]["n_parameters"] == 12
    objective = problem_of(cell, settings).objective
    criteria = objective.criteria(design.excitation.trajectory, 0.001)
    assert criteria == again.excitation.criteria
    assert "chosen" not in again.data["front"]
    grown = again.data["polished_from"]
    assert grown["point"] == design.origin
    before = (grown["log10_det"], grown["coupling_index"])
    assert before == design.origin_criteria.measures
    # never worse in either, by the millisecond
    assert criteria.log10_det >= before[0] and criteria.coupling_index <= before[1]


def test_what_is_no_file_in_a_folder_is_neither_waited_for_nor_read(tmp_path):
    folder = DesignFolder(tmp_path)
    os.mkfifo(folder.settings)
    with pytest.raises(InputError, match="holds no design to go on with"):
        folder.interrupted()
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        make(folder.journal)
        with pytest.raises(InputError, match="cannot be written to"), folder.opened_journal():
            pass
        folder.journal.unlink()


# Only what means the same is compared.


@pytest.fixture(scope="module")
def result(cell, tmp_path_factory) -> DesignResult:
    folder = DesignFolder(tmp_path_factory.mktemp("design") / "a")
    settings = preset("a").kinematic().replaced(search=TINY)
    return run_design(folder, cell, settings, Silent(), workers=1).result


@pytest.fixture
def saved(tmp_path):
    def saved(result: DesignResult) -> Path:
        result.save(tmp_path / "excitation.toml")
        return tmp_path / "excitation.toml"

    return saved


def changed(result: DesignResult, **tables: Any) -> DesignResult:
    return replace(result, data={**result.data, **tables})


def test_what_was_searched_without_looking_at_everything_is_marked(cell, result, saved):
    path = saved(result)
    found = references([path, path], cell, preset("b"), together=False)
    name, measures = "method A (kinematic)", result.excitation.criteria.measures
    assert found == {name: measures, f"{name} ({path})": measures}
    whole = changed(result, settings=preset("a").to_dict())
    assert set(references([saved(whole)], cell, preset("b"), together=False)) == {"method A"}


def test_another_robot_is_refused(cell, result, saved):
    heavier = cell.with_values({"robot.gravity": [0.0, 0.0, -1.62]})
    words = r"excitation\.toml: cell: was designed for the cell .*, whose robot is not that of"
    with pytest.raises(InputError, match=words):
        references([saved(result)], heavier, preset("b"), together=False)


def test_what_adds_to_archives_is_not_drawn_beside_what_does_not(cell, result, saved):
    archives = changed(result, earlier={"archives": [["a.mcap", "0" * 64]]})
    with pytest.raises(InputError, match=r"excitation\.toml: --compare: was designed with --earl"):
        references([saved(archives)], cell, preset("b"), together=False)
    with pytest.raises(InputError, match=r"^--compare: .*--earlier.*leave out one of the two"):
        references([saved(result)], cell, preset("b"), together=True)
    assert references([], cell, preset("b"), together=True) == {}


def test_other_parameters_are_not_drawn_beside_all(cell, result, saved):
    names = list(cell.model.parameter_names)
    some = preset("b").replaced(objective={"parameters": names[:3]})
    words = r"excitation\.toml: --compare: was judged by 58 parameters, this design by 3, of which"
    with pytest.raises(InputError, match=words + " 3 are the same; .*same \\[objective\\]"):
        references([saved(result)], cell, some, together=False)
    search = result.data["search"] | {"parameters": names[:3], "n_parameters": 3}
    subset = changed(result, search=search)
    assert references([saved(subset)], cell, some, together=False)
    others = preset("b").replaced(objective={"parameters": names[1:4]})
    with pytest.raises(InputError, match="by 3 parameters, this design by 3, of which 2 are"):
        references([saved(subset)], cell, others, together=False)
    everything = preset("b").replaced(objective={"parameters": names})
    assert references([saved(result)], cell, everything, together=False)
