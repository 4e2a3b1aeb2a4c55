from __future__ import annotations

import errno
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.base.files import lock_folder
from hil.cell import Cell
from hil.cli import app
from hil.design import METHODS, DesignResult, load_design
from hil.design.messages import NoExcitationError
from hil.design.settings import preset_text
from hil.plots import design_picture
from identification.excitation import CRITERIA
from sim_fixtures.ns16 import CELL_PATH

pytestmark = pytest.mark.long

SETTINGS = """\
method = "b"
[search]
population = 8
generations = 2
"""


DRAW = design_picture.draw_design
"""Slow; only `made` and the tests of Ctrl-C draw the page."""


@pytest.fixture(scope="module")
def invoke():
    def invoke(*arguments: object, draw=lambda *_: Figure()):
        with_workers = [*arguments, *([] if "--workers" in arguments else ["--workers", 1])]
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(design_picture, "draw_design", draw)
            return CliRunner().invoke(
                app, ["design", *map(str, with_workers)], catch_exceptions=False
            )

    return invoke


def edited(folder: Path, old: str, new: str) -> Path:
    """The NS 16's cell file with other text, in a folder."""
    cell = Cell.load(CELL_PATH)
    assert old in cell.text
    (folder / "cell.toml").write_text(cell.text.replace(old, new))
    (folder / "ns16.urdf").write_text(cell.urdf)
    return folder / "cell.toml"


@pytest.fixture(scope="module")
def bare(invoke, tmp_path_factory):
    """A design with joint limits only and its JSON output, read only."""
    root = tmp_path_factory.mktemp("bare")
    (root / "my.toml").write_text(SETTINGS)
    arguments = ("--settings", root / "my.toml", "--limits-only", "-o", root / "out", "--json")
    return root / "out", invoke(CELL_PATH, *arguments).stdout


@pytest.fixture
def copied(bare, tmp_path) -> Path:
    """A copy of it."""
    return Path(shutil.copytree(bare[0], tmp_path / "copied"))


@pytest.fixture
def settings(tmp_path) -> Path:
    path = tmp_path / "my.toml"
    path.write_text(SETTINGS)
    return path


@pytest.fixture(scope="module")
def made(invoke, tmp_path_factory):
    """A design with all constraints."""
    root = tmp_path_factory.mktemp("made")
    (root / "my.toml").write_text(SETTINGS)
    given = ("--settings", root / "my.toml", "-o", root / "out", "--seed", 3)
    result = invoke(CELL_PATH, *given, draw=DRAW)
    assert result.exit_code == 0, result.output
    return root / "out", result.output


def test_motion_picture_settings_and_journal_are_written(made):
    folder, output = made
    files = {"excitation.toml", "excitation.png", "settings.toml", "search.journal"}
    files |= {"cell.toml", "robot.urdf", "plan.json", "manifest.json", "archives"}
    assert {path.name for path in folder.iterdir()} == files
    text = " ".join(output.split())
    assert re.search(r"log det [\d.]+, .* of 1653", text), output
    assert f"{folder}/excitation.toml" in text
    excitation = load_design(folder)
    assert f"{excitation.tried} motions tried" in output
    assert all(f"{kind} {count}" in output for kind, count in excitation.rejected.items())
    pixels = matplotlib.image.imread(folder / "excitation.png")
    assert pixels.shape[0] > 800 and pixels.shape[1] > 800
    assert 0.02 < np.mean(np.any(pixels[..., :3] < 0.8, axis=2)) < 0.6


def test_the_motion_satisfies_the_constraints_and_is_closed(made):
    cell = Cell.load(CELL_PATH)
    excitation = load_design(made[0], cell)
    ends = excitation.trajectory.sample(np.array([0.0, excitation.trajectory.duration]))
    np.testing.assert_allclose(ends[0], [cell.home] * 2, atol=1e-9)
    np.testing.assert_allclose(ends[1:], 0.0, atol=1e-9)
    assert excitation.trajectory.duration <= 20.0
    from hil.control.motion_checks import MotionChecks  # builds the arm's shapes

    assert MotionChecks.of(cell).refusal(excitation.trajectory) is None


def test_the_result_does_not_depend_on_the_number_of_processes(invoke, made, settings, tmp_path):
    arguments = ("--settings", settings, "--seed", 3, "-o", tmp_path / "out", "--workers", 3)
    assert invoke(CELL_PATH, *arguments).exit_code == 0
    by_one_process, by_three_processes = (
        folder / "excitation.toml" for folder in (made[0], tmp_path / "out")
    )
    assert by_one_process.read_bytes() == by_three_processes.read_bytes()


def test_an_earlier_design_is_only_overwritten_with_force(invoke, settings, copied):
    """Other files are never removed."""
    arguments = (CELL_PATH, "--settings", settings, "--limits-only", "-o", copied, "--seed", 5)
    before = (copied / "excitation.toml").read_bytes()
    with pytest.raises(InputError, match=r"has a design already.*--resume.*--force"):
        invoke(*arguments)
    assert (copied / "excitation.toml").read_bytes() == before
    (copied / "notes.txt").write_text("mine")
    invoke(*arguments, "--force")
    assert load_design(copied).seed == 5
    assert (copied / "notes.txt").read_text() == "mine"
    (copied / "settings.toml").write_text("mine = true\n")
    for more in ((), ("--force",)):
        with pytest.raises(InputError, match=r"settings\.toml: exists and belongs to no design"):
            invoke(*arguments, *more)
    assert (copied / "settings.toml").read_text() == "mine = true\n"


@pytest.mark.parametrize("option", [("--force",), ("--resume",)])
def test_a_locked_folder_is_refused(invoke, settings, copied, option):
    def content():
        return {path.name: path.read_bytes() for path in copied.iterdir()}

    before = content()
    given = () if option == ("--resume",) else ("--settings", settings, "--limits-only")
    with (
        lock_folder(copied, "search", "-o"),
        pytest.raises(InputError, match=r"copied: a search is running in it; wait") as caught,
    ):
        invoke(CELL_PATH, *given, "-o", copied, *option)
    assert "--force" not in str(caught.value)
    assert content() == before
    invoke(CELL_PATH, "--resume", "-o", copied)


def test_the_folder_is_locked_until_the_picture_is_saved(invoke, copied):
    def meanwhile(*_):
        with pytest.raises(InputError, match="a search is running"):
            lock_folder(copied, "search", "-o").__enter__()
        return Figure()

    (copied / "excitation.toml").unlink()
    before = invoke(CELL_PATH, "--resume", "-o", copied, draw=meanwhile)
    assert before.exit_code == 0 and (copied / "excitation.toml").exists()


def test_a_result_that_cannot_be_written_names_file_and_remedy(invoke, copied, monkeypatch):
    def full(path, _):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))

    monkeypatch.setattr("hil.design.result.write_atomically", full)
    message = r"excitation\.toml: cannot be written \(No space.*--resume"
    with pytest.raises(InputError, match=message):
        invoke(CELL_PATH, "--resume", "-o", copied)


def test_a_picture_that_cannot_be_written_is_a_warning(invoke, copied):
    before = (copied / "excitation.toml").read_bytes()
    (copied / "excitation.png").unlink()
    (copied / "excitation.png").mkdir()
    result = invoke(CELL_PATH, "--resume", "-o", copied, "--quiet")
    assert result.exit_code == 0
    assert result.stdout.startswith("log det ")
    assert "warning: " in result.stderr and "excitation.png: cannot be written" in result.stderr
    assert (copied / "excitation.toml").read_bytes() == before
    assert not list(copied.glob("*.tmp"))


def test_json_agrees_with_the_file(bare):
    printed = json.loads(bare[1])
    result = DesignResult.load(bare[0])
    for name in ("log10_det", "coupling_index", "condition"):
        assert printed[name] == getattr(result.excitation.criteria, name)
    assert printed["complete"] is True
    assert Path(printed["file"]) == bare[0] / "excitation.toml"
    given = result.settings.constraints
    assert not (given.closed or given.collision or given.current)


def test_what_was_not_checked_is_reported(invoke, bare, copied, tmp_path):
    unchecked = ["floor", "walls", "the arm itself", "motor currents"]
    result = invoke(CELL_PATH, "--resume", "-o", copied, "--quiet")
    assert f"warning: not checked: {', '.join(unchecked)}" in result.stderr
    assert json.loads(bare[1])["unchecked"] == unchecked
    path = tmp_path / "bare.toml"
    path.write_text('method = "a"\n[search]\npopulation = 8\ngenerations = 1\n[sines]\nramp = 0\n')
    output = invoke(CELL_PATH, "--settings", path, "--limits-only", "-o", tmp_path / "o").output
    assert f"not checked: {', '.join(unchecked)}, rest at both ends" in output


def test_no_feasible_motion_names_constraints_and_remedies(invoke, settings, tmp_path):
    settings.write_text(SETTINGS + "[constraints]\nmax_duration = 0.5\n")
    message = r"duration excludes 16.* 0\.5 s.*\[constraints\] max_duration"
    with pytest.raises(NoExcitationError, match=message) as caught:
        invoke(CELL_PATH, "--settings", settings, "--limits-only", "-o", tmp_path / "out")
    assert caught.value.exit_code == 3
    assert not (tmp_path / "out" / "excitation.toml").exists()


def test_a_contact_at_home_is_reported_before_the_search(invoke, settings, tmp_path):
    wall = "walls = [{lower = [0.3, -2.0, 0.8], upper = [0.4, 2.0, 2.5]}]"
    path = edited(tmp_path, "walls = []", wall)
    message = r"begin at home: collision of link_\d and box 0: -0\.\d+ m.*home_deg.*cell\.toml"
    with pytest.raises(NoExcitationError, match=message):
        invoke(path, "--settings", settings, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "no cell file"),
        (
            [CELL_PATH, "--method", "b", "--settings", "SETTINGS"],
            "--method and --settings: exclude each other",
        ),
        ([CELL_PATH, "--resume", "--force"], "exclude each other"),
        ([CELL_PATH, "--resume", "-o", "NOWHERE"], "has no design to resume"),
        ([CELL_PATH, "--settings", "NOWHERE"], "cannot be read"),
        (["NOWHERE"], "cannot be read"),
        ([CELL_PATH, "-o", "SETTINGS"], "cannot be created"),
    ],
)
def test_invalid_arguments_are_refused(invoke, settings, tmp_path, arguments, message):
    names = {"SETTINGS": settings, "NOWHERE": tmp_path / "nowhere"}
    given = [names.get(argument, argument) for argument in arguments]
    if "-o" not in given:
        given += ["-o", tmp_path / "out"]
    with pytest.raises(InputError, match=message):
        invoke(*given)
    assert not (tmp_path / "out").exists()


def test_other_settings_or_another_cell_cannot_resume_a_search(invoke, bare, tmp_path):
    with pytest.raises(InputError, match="differ from the requested settings"):
        invoke(CELL_PATH, "--resume", "-o", bare[0], "--seed", 2)
    path = edited(tmp_path, "[155.0, 155.0,", "[150.0, 155.0,")
    with pytest.raises(InputError, match=r"search\.journal: this journal .* cell limits was"):
        invoke(path, "--resume", "-o", bare[0])


def test_a_journal_with_other_criteria_is_refused(invoke, copied, monkeypatch):
    monkeypatch.setitem(CRITERIA, "condition", CRITERIA["log10_det"])
    with pytest.raises(InputError, match=r"criteria names was \['log10_det', 'coupling_index'\]"):
        invoke(CELL_PATH, "--resume", "-o", copied)


def test_every_method_is_offered(invoke):
    """A wrong name is refused with the names; `tests.hil.cli.test_help` reads their description."""
    shown = " ".join(invoke("--help").stdout.replace("│", " ").split())
    assert f"Search method: {', '.join(METHODS)}." in shown
    for name in METHODS:
        assert invoke("--show-settings", name).stdout == preset_text(name)
    for option in ("--method", "--show-settings"):
        output = invoke(CELL_PATH, option, "x").output
        assert "Value error" not in output and all(f"'{name}'" in output for name in METHODS)


def test_settings_are_read_from_a_result_file(invoke, bare, tmp_path):
    out = tmp_path / "out"
    given = ("--settings", bare[0] / "excitation.toml", "-o", out)
    assert invoke(CELL_PATH, *given).exit_code == 0
    first, second = (folder / "excitation.toml" for folder in (bare[0], out))
    assert first.read_bytes() == second.read_bytes()


def interrupted(command: list[str], journal: Path) -> tuple[int, str]:
    """Run a search and interrupt it after three generations in the journal."""
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as run:
        deadline = time.monotonic() + 60.0
        while not journal.exists() or journal.stat().st_size < 3 * 8 * 51 * 8:
            assert time.monotonic() < deadline
            assert run.poll() is None, run.communicate()
            time.sleep(0.02)
        run.send_signal(signal.SIGINT)
        _, text = run.communicate(timeout=60)
    return run.returncode, text


def test_ctrl_c_writes_the_best_motion_and_resume_continues(invoke, tmp_path):
    settings = tmp_path / "my.toml"
    settings.write_text(SETTINGS.replace("generations = 2", "generations = 25"))
    arguments = [str(CELL_PATH), "--settings", str(settings), "--limits-only"]
    out = tmp_path / "out"
    command = [sys.executable, "-m", "hil", "design", *arguments, "-o", str(out)]
    code, text = interrupted(command, out / "search.journal")
    assert code == 130, text
    assert "continue with --resume" in text
    half = DesignResult.load(out)
    assert not half.complete and 1 <= half.data["search"]["generations"] < 25
    assert invoke(CELL_PATH, "--resume", "-o", out).exit_code == 0
    invoke(*arguments, "-o", tmp_path / "whole")
    whole = (tmp_path / "whole" / "excitation.toml").read_bytes()
    assert (out / "excitation.toml").read_bytes() == whole


def test_ctrl_c_during_start_up_has_no_traceback():
    script = """
import os, signal, sys
class Interrupting:
    def find_spec(self, name, *_):
        if name == "numpy":
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Interrupting())
sys.argv = ["hil", "design", "cell.toml"]
from hil.__main__ import main
main()
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (130, "stopped: interrupted\n")
