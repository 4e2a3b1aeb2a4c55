"""Cell files: refused with a `CellError` with place and remedy, or usable in all parts."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np

from hil.base.errors import HilError, InputError
from hil.cell import Cell, CellError
from tests.fuzz.draw import mutate_text
from tests.fuzz.targets import Target, place_of
from tests.hil.fast_cell import CELL, URDF

LINKS = """[controller]
transport = "udp"
host = "10.2.12.150"
port = 1000
bind = "0.0.0.0"
cycle_ms = 2
arm = 1
current_delay_cycles = 0.35
"""
CAN = """[controller]
transport = "can"
cycle_ms = 2
[controller.can]
interface = "socketcan"
channel = "can0"
profile = "fd"
"""
OTHERS = """
[robot.friction.joints.elbow]
stribeck = 0.2

[robot.coupling]
motor_from_joint = [[1.0, 0.0], [0.5, 1.0]]

[robot.payload]
mass = 1.5
centre = [0.0, 0.0, 0.1]

[bounds.override]
acceleration = 1.3
jerk = 1.7

[workspace]
floor = 0.0
walls = [{ lower = [1.0, -1.0, 0.0], upper = [1.2, 1.0, 2.0] }]
margin = 0.02
"""


@lru_cache
def folder() -> Path:
    """Where the file under test lies, beside its URDF."""
    made = place_of("cell")
    (made / "fast.urdf").write_text(URDF)
    return made


def run(data: bytes) -> bool:
    """Load the file if possible; use everything that commands use."""
    path = folder() / "cell.toml"
    path.write_bytes(data)
    try:
        cell = Cell.load(path)
    except CellError as error:
        explained(error, path)
        return False
    again = Cell.from_texts(cell.text, cell.urdf, path)
    assert again.text == cell.text
    used(cell)
    changed(cell)
    return True


def explained(error: HilError, path: Path) -> None:
    """An error of the input is one sentence that names the file and a remedy."""
    assert getattr(error, "path", None) == path, error
    assert getattr(error, "remedy", ""), f"no remedy: {error}"
    assert getattr(error, "problem", ""), f"no problem: {error}"


def used(cell: Cell) -> None:
    """All that is built of a cell; what a table lacks is a `CellError`."""
    n = len(cell.joint_names)
    makers: tuple[Callable[[], object], ...] = (
        lambda: cell.joint_limits, lambda: cell.guard_limits, lambda: cell.drive_train,
        lambda: cell.torque_limit, lambda: cell.session_settings(), lambda: cell.transport_spec(),
        lambda: cell.only_simulated, lambda: cell.workspace, lambda: cell.home,
        lambda: cell.initial, lambda: cell.nominal_values(), lambda: cell.period,
        lambda: cell.mesh_folders,
        lambda: cell.controller_angles(np.zeros(n)), lambda: cell.campaign,
    )  # fmt: skip
    for make in makers:
        try:
            made = make()
        except CellError as error:
            explained(error, cell.path)
            continue
        if isinstance(made, np.ndarray):
            assert np.isfinite(made).all(), "numbers that are not finite"
    try:
        limits = cell.joint_limits
    except CellError:
        return
    assert (limits.lower < limits.upper).all()
    assert limits.n_joints == n


def changed(cell: Cell) -> None:
    """Check that a change of link or repetitions leaves the rest unchanged."""
    changes: tuple[Callable[[], Cell], ...] = (
        lambda: cell.with_link(transport="udp", host="127.0.0.1", port=4000, cycle_ms=2),
        lambda: cell.with_link(transport="simulated"),
        lambda: cell.with_campaign(repetitions=3, validation_runs=1),
        lambda: cell.with_urdf(cell.path.with_name("b.toml"), "other.urdf"),
    )
    for change in changes:
        try:
            other = change()
        except (CellError, InputError) as error:
            assert error.remedy, error
            continue
        assert other.file.limits == cell.file.limits
        assert other.file.drive_train == cell.file.drive_train
        assert other.file.robot == cell.file.robot
        assert other.file.workspace == cell.file.workspace


def seeds() -> list[bytes]:
    """A simulated cell, one on each link, one with all optional tables."""
    begin, end = CELL.split("[controller]")
    campaign = end[end.index("[campaign]") :]
    texts = [CELL, begin + LINKS + campaign, begin + CAN + campaign, CELL + OTHERS, begin]
    return [text.encode() for text in texts]


TARGET = Target(run, seeds, mutate_text, most=6000, replayed=120)
