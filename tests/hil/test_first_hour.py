"""Every command of docs/first-hour.md does what the page says, against a simulated controller."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from hil.archive import open_archive
from hil.cell import Cell
from hil.cell.errors import UnknownFieldsError
from hil.cell.text import with_values
from hil.demo_link import free_port
from tests.docs import typed

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "docs" / "first-hour.md"


def commands() -> list[list[str]]:
    """The page's command lines, in order."""
    return typed.commands(DOCUMENT)


def edit(path: Path, **instead: int) -> None:
    """What the page says is to be written into `[controller]` of the copy."""
    (block,) = re.findall(r"```toml\n(.*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL)
    link = {f"controller.{key}": value for key, value in (tomllib.loads(block) | instead).items()}
    path.write_text(with_values(path.read_text("utf-8"), link))


def hil(arguments: list[str], folder: Path) -> subprocess.Popen[str]:
    assert arguments[0] == "hil"
    return subprocess.Popen(
        [sys.executable, "-m", *arguments], cwd=folder, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


@pytest.mark.slow
def test_the_commands_of_the_page_run_in_their_order(tmp_path: Path) -> None:
    (tmp_path / "sim_fixtures").symlink_to(ROOT / "sim_fixtures")
    simulate, *steps = commands()
    assert [step[1] for step in steps] == [
        "new", "sim_fixtures/ns16/cell.toml", "doctor", "record", "plot", "move", "plot", "move"
    ]  # fmt: skip
    port = str(free_port())
    for step in steps:
        if step[0] == "cp":
            for name in step[1:-1]:
                shutil.copy(tmp_path / name, tmp_path / step[-1])
            edit(tmp_path / "cell.toml", port=int(port))
            continue
        needs_controller = step[1] in {"new", "record", "move"}
        # A computer that runs tests need not be fit for a robot.
        far = [part.replace("2001", port) for part in simulate] + ["--patience", "0.5"]
        controller = hil(far, tmp_path) if needs_controller else None
        step = [part.replace("2001", port) for part in step]
        done = hil(step, tmp_path)
        said, _ = done.communicate(timeout=180)
        if controller is not None:
            controller.terminate()
            controller.communicate(timeout=60)
            time.sleep(0.1)
        # doctor --quick is provisional: 5, whatever this computer can do.
        assert done.returncode == (5 if step[1] == "doctor" else 0), (step, said)
        if step[1] == "new":
            with pytest.raises(UnknownFieldsError) as unknown:
                Cell.load(tmp_path / "cell.toml")
            assert len(unknown.value.fields) == 12
            assert "twelve fields" in DOCUMENT.read_text("utf-8")
    moves = sorted((tmp_path / "moves").glob("*.mcap"))
    assert [open_archive(path).kind for path in moves] == ["move", "move"]
    assert all(open_archive(path).complete for path in moves)
    assert open_archive(tmp_path / "archives" / "standstill_000_a1.mcap").complete
    assert (tmp_path / "standstill.png").exists()
    assert (tmp_path / "first_move.png").exists()


def test_the_copy_of_the_simulated_arms_cell_is_whole_and_reaches_the_controller_of_the_page(
    tmp_path: Path,
) -> None:
    (copy,) = (step for step in commands() if step[0] == "cp")
    for name in copy[1:-1]:
        shutil.copy(ROOT / name, tmp_path)
    edit(tmp_path / "cell.toml")
    cell = Cell.load(tmp_path / "cell.toml")
    assert cell.only_simulated
    (simulate,) = (step for step in commands() if step[1] == "simulate")
    assert simulate[-1] == f"{cell.controller.host}:{cell.controller.port}"


def test_the_list_names_every_field_that_hil_new_leaves_open() -> None:
    from hil.cell.errors import WHERE

    items = re.findall(r"(?m)^- (`.*?):", DOCUMENT.read_text("utf-8"))
    said = {field for item in items for field in re.findall(r"`(\w+)`", item)}
    fields = {name.partition(".")[2] for name in WHERE}
    told = {
        "lower_deg", "upper_deg", "velocity_deg", "gear_ratio", "calibration", "k54", "k64", "k65",
        "current_limit", "following_error", "cycle_ms", "host", "mesh_folders",
    }  # fmt: skip
    assert len(said) == 12
    assert fields - told == said  # the others come from URDF and init packet


def test_the_page_and_the_command_line_know_the_same_options() -> None:
    """Quick, for every run: each option of the page is one of its command."""
    from typer.main import get_command

    from hil.cli import app

    group = get_command(app)
    for command in commands():
        if command[0] != "hil":
            continue
        parameters = group.commands[command[1]].params  # type: ignore[attr-defined]
        known = {option for parameter in parameters for option in parameter.opts}
        given = {part for part in command[2:] if part.startswith("-")}
        assert given <= known, command
