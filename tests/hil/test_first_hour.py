"""Every command of docs/first-hour.md does what the page says, against a simulated controller."""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hil.archive import open_archive
from hil.cell import Cell
from hil.cell.unknown import UnknownFieldsError
from hil.demo_link import free_port
from sim_fixtures.ns16 import CELL_PATH
from tests.hil.new_cells import filled_in

ROOT = Path(__file__).parents[2]
DOCUMENT = ROOT / "docs" / "first-hour.md"


def commands() -> list[list[str]]:
    """The page's command lines, in order."""
    blocks = re.findall(r"```\n(.*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL)
    return [shlex.split(line) for block in blocks for line in block.splitlines() if line]


def hil(arguments: list[str], folder: Path) -> subprocess.Popen[str]:
    assert arguments[0] == "hil"
    return subprocess.Popen(
        [sys.executable, "-m", *arguments], cwd=folder, stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def fill_in(path: Path) -> None:
    """What the person knows of the NS 16, from its own cell file; still over UDP."""
    own = Cell.load(CELL_PATH).file
    assert own.limits is not None
    assert own.drive_train is not None
    assert own.nominal is not None
    drives = own.drive_train
    text = filled_in(
        path, 6,
        limits__frame="controller",
        limits__lower_deg=own.limits.lower_deg, limits__upper_deg=own.limits.upper_deg,
        limits__velocity_deg=own.limits.velocity_deg, limits__torque=[],
        limits__acceleration_deg=own.limits.acceleration_deg, limits__jerk_deg=own.limits.jerk_deg,
        campaign__home_deg=[0.0, 0.0, -90.0, 0.0, 90.0, 0.0],
        workspace__floor=0.0,
        nominal__rotor_inertia=own.nominal.rotor_inertia,
        nominal__coulomb=own.nominal.coulomb, nominal__viscous=own.nominal.viscous,
        drive_train__joint_sign=drives.joint_sign,
        drive_train__joint_offset_deg=drives.joint_offset_deg,
        drive_train__torque_constant=drives.torque_constant,
    )  # fmt: skip
    path.write_text(text.replace('transport = "simulated"', 'transport = "udp"'))


@pytest.mark.slow
def test_the_commands_of_the_page_run_in_their_order(tmp_path: Path) -> None:
    (tmp_path / "sim_fixtures").symlink_to(ROOT / "sim_fixtures")
    simulate, *steps = commands()
    assert [step[1] for step in steps] == [
        "new", "doctor", "record", "plot", "move", "plot", "move"
    ]  # fmt: skip
    port = str(free_port())
    for step in steps:
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
            with pytest.raises(UnknownFieldsError):
                Cell.load(tmp_path / "cell.toml")
            fill_in(tmp_path / "cell.toml")
    moves = sorted((tmp_path / "moves").glob("*.mcap"))
    assert [open_archive(path).kind for path in moves] == ["move", "move"]
    assert all(open_archive(path).complete for path in moves)
    assert open_archive(tmp_path / "archives" / "standstill_000_a1.mcap").complete
    assert (tmp_path / "standstill.png").exists()
    assert (tmp_path / "first_move.png").exists()


def test_the_page_and_the_command_line_know_the_same_options() -> None:
    """Quick, for every run: each option of the page is one of its command."""
    from typer.main import get_command

    from hil.cli import app

    group = get_command(app)
    for command in commands():
        parameters = group.commands[command[1]].params  # type: ignore[attr-defined]
        known = {option for parameter in parameters for option in parameter.opts}
        given = {part for part in command[2:] if part.startswith("-")}
        assert given <= known, command
