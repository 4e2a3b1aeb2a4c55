"""Result files of designs."""

from __future__ import annotations

import os
import re

import numpy as np
import pytest

from hil.base.errors import InputError
from hil.base.progress import Silent
from hil.cell import Cell
from hil.design import DesignResult, load_design, preset, problem_of
from hil.design.design import Designed, DesignFolder, run_design
from hil.design.result import _seal, fingerprint
from sim_fixtures.ns16 import CELL_PATH

pytestmark = pytest.mark.long

TINY = {"population": 8, "generations": 2}


@pytest.fixture(scope="module")
def ns16() -> Cell:
    return Cell.load(CELL_PATH)


@pytest.fixture(scope="module", params=["a", "b"])
def made(request, ns16, tmp_path_factory) -> tuple[DesignFolder, Designed]:
    folder = DesignFolder(tmp_path_factory.mktemp("design") / request.param)
    settings = preset(request.param).kinematic().replaced(search=TINY)
    return folder, run_design(folder, ns16, settings, Silent(), workers=1)


@pytest.fixture
def text(made) -> str:
    return made[0].result.read_text()


def written(folder, text):
    path = folder / "excitation.toml"
    path.write_text(text)
    return path


def test_the_file_restores_everything(made, ns16):
    folder, done = made
    again = DesignResult.load(folder.result)
    assert again.excitation.to_dict() == done.design.excitation.to_dict()
    assert load_design(folder.root, ns16).to_dict() == again.excitation.to_dict()
    assert again.settings == done.result.settings and again.complete
    front = again.data["front"]
    assert front["chosen"] == done.design.chosen
    for name in ("log10_det", "coupling_index"):
        np.testing.assert_array_equal(front[name], done.design.front.measure(name))
    search = again.data["search"]
    assert (search["generations"], search["n_parameters"]) == (2, 58)
    assert again.data["software"] == done.result.data["software"]
    assert {"hil", "ruckig", "pymoo", "numpy"} <= again.data["software"].keys()
    assert "polished_from" not in again.data


def test_a_motion_that_was_changed_is_refused(made, text, tmp_path):
    sines = "amplitude_deg" in text
    for name in ("amplitude_deg" if sines else "target_deg", "coupling_index"):
        last = rf"({name} = \[+-?[\d.]*)(\d)"  # digit of the first number of a list
        new, count = re.subn(last, lambda m: f"{m[1]}{(int(m[2]) + 1) % 10}", text, count=1)
        assert count == 1
        with pytest.raises(InputError, match=r"excitation\.toml: was changed after.*restore it"):
            load_design(written(tmp_path, new))


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('format = "designed excitation"', 'format = "joint motion plan"', "format is"),
        ("version = 1", "version = 2", "version is 2, this reads 1"),
        (r"\[seal\]", "[seals]", "'seal'"),
        (r"\[criteria\]", "[criteria", "not a designed excitation"),
        # with a matching seal
        (r"(?m)^coupling_index = .*$", 'coupling_index = "59"', "not a designed excitation"),
        (r"(?m)^n_samples = .*$", "n_samples = 20001.0", "not a designed excitation"),
        (r"(?m)^seed = .*$", 'seed = "1"', "not a designed excitation"),
        (r"(?m)^complete = .*$", "complete = 1", "not a designed excitation"),
    ],
)
def test_another_file_is_refused(text, tmp_path, old, new, message):
    changed, count = re.subn(old, new, text, count=1)
    assert count == 1
    if old.startswith("(?m)"):
        changed = re.sub(r'(?m)^sha256 = "\w+"', f'sha256 = "{_seal(changed)}"', changed)
    with pytest.raises(InputError, match=message) as caught:
        load_design(written(tmp_path, changed))
    assert "excitation.toml: " in str(caught.value) and "design it again" in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (r"(positions_deg = \[\[)[^,]+", r"\g<1>45.0", "planning its moves does not give"),
        (r"(?s)positions_deg = \[\[.*\]\]", 'positions = "x"', "is not a designed excitation"),
        (r"(?s)positions_deg = \[\[.*\]\]", "positions = [[1.0], [2.0, 3.0]]",
         "is not a designed excitation"),
    ],
)  # fmt: skip
def test_the_planned_motion_is_compared_with_the_designed_one(text, tmp_path, old, new, message):
    changed, count = re.subn(old, new, text)
    assert count == 1
    with pytest.raises(InputError, match=message):
        load_design(written(tmp_path, changed))


def test_a_cell_with_other_limits_is_refused_by_name(made, ns16):
    slow = [100.0, 155.0, 170.0, 360.0, 350.0, 550.0]
    other = ns16.with_values({"limits.velocity_deg": slow, "cell.name": "the slow one"})
    with pytest.raises(InputError) as caught:
        load_design(made[0].result, other)
    for word in ("'NS 16 (simulated)'", "'the slow one'", "limits"):
        assert word in str(caught.value)


def test_another_campaign_link_or_wall_is_the_same_robot(made, ns16):
    other = ns16.with_campaign(repetitions=3).with_link(transport="udp", host="127.0.0.1")
    respelled = other.text.replace("margin = 0.05", "margin = 5e-2  # m")
    assert respelled != other.text
    other = Cell.from_texts(respelled, ns16.urdf, ns16.path)
    assert fingerprint(other) == fingerprint(ns16)
    wall = {"lower": [2.0, 2.0, 0.0], "upper": [2.1, 2.1, 1.0]}
    walled = ns16.with_values({"workspace.walls": [wall]})
    assert fingerprint(walled) != fingerprint(ns16)
    for each in (other, walled):
        load_design(made[0].result, each)


def test_a_subset_and_steps_along_the_gradient_are_recorded(ns16, tmp_path):
    names = list(ns16.model.parameter_names[:12])
    settings = preset("gradient").kinematic()
    settings = settings.replaced(
        search=TINY | {"gradient": 4, "starts": 1}, objective={"parameters": names}
    )
    folder = DesignFolder(tmp_path / "few")
    design = run_design(folder, ns16, settings, Silent(), workers=2).design
    again = DesignResult.load(folder.result)
    assert again.data["search"]["parameters"] == names
    assert again.data["search"]["n_parameters"] == 12
    objective = problem_of(ns16, settings).objective
    criteria = objective.criteria(design.excitation.trajectory, 0.001)
    assert criteria == again.excitation.criteria
    assert "chosen" not in again.data["front"]
    grown = again.data["polished_from"]
    assert grown["point"] == design.origin
    before = (grown["log10_det"], grown["coupling_index"])
    assert before == design.origin_criteria.measures
    # not worse in the weighted sum, sampled every millisecond
    gains = np.subtract(criteria.measures, before)
    assert np.dot(gains, [0.75, -0.25]) >= 0.0


@pytest.mark.parametrize(
    ("old", "new"),
    [
        (r'(?m)^method = "\w+"$', 'method = "front"'),  # of the settings and of the search
        (r"(?m)^mutation = .*$", r"\g<0>\npolish = 6000"),
    ],
)
def test_a_design_of_a_former_method_is_read(made, text, tmp_path, old, new):
    """Its motion stays what it was; its method is what the file names."""
    changed, count = re.subn(old, new, text)
    assert count >= 1
    changed = re.sub(r'(?m)^sha256 = "\w+"', f'sha256 = "{_seal(changed)}"', changed)
    read = DesignResult.load(written(tmp_path, changed)).excitation
    assert read.trajectory.duration == made[1].design.excitation.trajectory.duration
    assert read.method == ("front" if "front" in new else made[1].design.excitation.method)


def test_special_files_in_a_folder_are_refused(tmp_path):
    folder = DesignFolder(tmp_path)
    os.mkfifo(folder.settings)
    with pytest.raises(InputError, match="has no design to resume"):
        folder.resumed_settings()
    for make in (os.mkfifo, lambda path: path.symlink_to("/dev/zero")):
        make(folder.journal)
        with pytest.raises(InputError, match="cannot be written to"), folder.opened_journal():
            pass
        folder.journal.unlink()
