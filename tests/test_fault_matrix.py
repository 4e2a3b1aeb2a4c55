"""Every fault in every situation has the outcome of docs/limits.md#fault-matrix, and breaks no law.

The laws are those of `tests.drivers.judge`; also, the arm comes to rest, and a new motion completes
after the drive was switched on again.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers import SimulatedTransport
from drivers.ur.wire import UrWire
from hil.archive import Archive, ArchiveSpec, open_archive
from hil.campaign import Stop, VirtualLink
from hil.cell import Cell
from hil.cell.toml_edits import with_values
from hil.control.motions import START_TOLERANCE, player_of
from hil.control.simulated_cell import controller_settings, simulated_controller
from identification.text import percentage
from planner import PiecewiseCubic, plan
from sim_fixtures.faults import parse_fault, split_faults
from sim_fixtures.ns16 import CELL_PATH
from sim_fixtures.ur import SimulatedUr
from tests.fault_matrix import ur_runs
from tests.fault_matrix.__main__ import expected
from tests.fault_matrix.faulty_runs import (
    BEHAVIOURS,
    FAULTS,
    FAULTS_AT_SPEED,
    SITUATIONS,
    SPEEDS,
    behaviours,
    cases,
    cycles_without_a_fault,
    play,
    play_at,
)
from tests.laws.evidence import ArchiveFile, Evidence
from tests.laws.motions import slows_down
from tests.laws.second_reader import read
from tests.laws.table import broken

pytestmark = pytest.mark.safety

EXPECTED = expected(SITUATIONS[0])
SHARES = [percentage(share) for share in SPEEDS]
AT_SPEED = expected(SHARES[0])
OF_UR = expected(ur_runs.SITUATIONS[0])


def test_the_table_has_every_fault_in_every_situation() -> None:
    assert list(EXPECTED) == list(FAULTS)
    assert list(AT_SPEED) == list(FAULTS_AT_SPEED)
    for fault, outcomes in EXPECTED.items():
        assert list(outcomes) == list(SITUATIONS), fault
        for situation, texts in outcomes.items():
            assert len(texts) in (1, len(behaviours(fault, situation))), (fault, situation)


def test_without_a_fault_every_situation_comes_about() -> None:
    assert set(SITUATIONS) - {"open at rest"} <= set(cycles_without_a_fault(True))
    assert "open at rest" in cycles_without_a_fault(False)


@pytest.mark.parametrize(
    ("fault", "situation", "while_silent"),
    [pytest.param(*case, id=f"{case[0]}, {case[1]}, {case[2]}") for case in cases()],
)
def test_fault(fault: str, situation: str, while_silent: str) -> None:
    run = play(fault, situation, while_silent)
    texts = EXPECTED[fault][situation]
    outcome = texts[behaviours(fault, situation).index(while_silent) if len(texts) > 1 else 0]
    assert run.outcome == outcome
    assert run.broken == []
    if outcome != "no start":
        assert run.recovery.startswith("completed")


def test_a_ur_controller_has_every_fault_in_every_situation() -> None:
    assert list(OF_UR) == list(ur_runs.FAULTS)
    assert all(tuple(outcomes) == ur_runs.SITUATIONS for outcomes in OF_UR.values())
    for is_held in (False, True):
        wanted = {*ur_runs.SITUATIONS} - ({"held"} if not is_held else set())
        assert wanted <= set(ur_runs.cycles_without_a_fault(is_held))


@pytest.mark.parametrize(("fault", "situation"), [*ur_runs.cases()])
def test_fault_of_a_ur_controller(fault: str, situation: str) -> None:
    run = ur_runs.play(fault, situation)
    assert [run.outcome] == [*OF_UR[fault][situation]]
    assert run.broken == []
    assert run.recovery.startswith("completed")


@pytest.mark.parametrize(
    ("defect", "law"),
    [
        ("write", "sent and recorded differ"),
        ("finish", "its sum is another one"),
        ("_require_undisturbed", "the arm is slowed down"),
        ("_require_startable", "a program over another one"),
    ],
)
def test_the_judge_of_a_ur_session_finds_defects(
    defect: str, law: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ur_runs.cycles_without_a_fault(False)  # with a sound one
    sound = getattr(UrWire, defect)

    def broken_one(wire: UrWire, *arguments: Any) -> Any:
        if defect == "write":
            return sound(wire, arguments[0] + 0.5 * (wire._cycle > 150), arguments[1])
        if defect == "finish":
            frame = bytearray(sound(wire))
            frame[20] ^= 1
            return bytes(frame)
        return None

    monkeypatch.setattr(UrWire, defect, broken_one)
    if defect == "_require_startable":
        playing = property(lambda robot: True)
        monkeypatch.setattr(SimulatedUr, "playing", playing)
    run = ur_runs.play("slider at 50 %", "moving")
    assert any(law in text for _, text in run.broken), run.broken


@pytest.mark.parametrize("while_silent", BEHAVIOURS)
@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("fault", FAULTS_AT_SPEED)
def test_fault_at_speed(fault: str, speed: float, while_silent: str) -> None:
    """The arm comes to rest, whatever the controller did meanwhile."""
    run = play_at(fault, speed, while_silent)
    texts = AT_SPEED[fault][SHARES[SPEEDS.index(speed)]]
    assert run.outcome.partition(" (")[0] == (texts * 3)[BEHAVIOURS.index(while_silent)]
    assert run.broken == []
    assert run.recovery.startswith("completed")


def on_ns16(
    cell: Cell, path: PiecewiseCubic, file: Path, fault: str = "", silent: str = "hold"
) -> Archive:
    settings = replace(controller_settings(cell), missed_replies=13, while_silent=silent)
    controller = simulated_controller(cell, settings=settings)
    faults = split_faults([parse_fault(fault)])[0] if fault else ()
    link = VirtualLink.over(SimulatedTransport(controller, faults), cell, finish=controller.finish)
    link.connect(Stop())
    spec = ArchiveSpec(file, cell.joint_names, cell.period, {"kind": "move"}, durable=False)
    ended = link.run(player_of(cell, path), spec, Stop())
    archive = open_archive(file)
    assert controller.reason == "", "the drive stays on"
    assert archive.complete
    missed = archive.outcome.lost_packets or 0
    whole = ArchiveFile(read(file), archive.complete, missed=missed)
    assert broken(Evidence(period=cell.period, files=(whole,))) == []
    assert archive.outcome.outcome == ended.outcome == ("stopped" if fault else "completed")
    return archive


@pytest.fixture(scope="module")
def cell() -> Cell:
    """The NS 16 in a cycle of 2 ms."""
    text = with_values(CELL_PATH.read_text("utf-8"), {"controller.cycle_ms": 2})
    return Cell.from_texts(text, Cell.load(CELL_PATH).urdf, CELL_PATH)


@pytest.fixture(scope="module")
def begun(cell: Cell, tmp_path_factory) -> int:
    """Packet in which each motion of it begins."""
    file = tmp_path_factory.mktemp("sound") / "move.mcap"
    archive = on_ns16(cell, plan([cell.initial, cell.initial + 0.01], cell.joint_limits), file)
    moves = np.nan_to_num(archive.columns["commanded_velocity"]).any(axis=1)
    return int(archive.columns["cycle"][np.argmax(moves)]) + 9  # sync packets before init


class TestNs16AtSpeed:
    """A cycle of 2 ms, thresholds of one revolution, a tenth of one per cycle at full speed.

    The arm comes to rest on its path with the drive on, and its archive is whole.
    """

    WAY = np.array([0.5, 0.5, -0.5, 0.5, -0.4, 0.5])

    @pytest.mark.parametrize("share", SPEEDS)
    @pytest.mark.parametrize(
        ("fault", "silent"),
        [
            ("lose@{c}x3", "continue"),
            ("lose@{c}x5", "continue"),
            ("lose@{c}x5:to_controller", "hold"),
        ],
    )
    def test_it_stops_on_a_straight_path(self, cell, begun, tmp_path, fault, silent, share):
        limits = cell.joint_limits
        way = self.WAY * limits.velocity
        slow = replace(limits, velocity=share * limits.velocity)
        path = plan([cell.initial, cell.initial + way], slow)
        strike = begun + round(0.5 * path.duration / cell.period)
        archive = on_ns16(cell, path, tmp_path / "a.mcap", fault.format(c=strike), silent)
        q, v = (archive.columns[f"commanded_{name}"] for name in ("position", "velocity"))
        assert np.nanmax(np.abs(v[:, 0])) == pytest.approx(share * limits.velocity[0], rel=0.02)
        q = q[np.isfinite(q).all(axis=1)] - cell.initial
        along = (q @ way) / (way @ way)
        assert np.all(np.diff(along) >= 0.0) and along[-1] < 0.95
        np.testing.assert_allclose(q, along[:, None] * way, atol=1e-6)
        if "to_controller" in fault:
            # The planned speed is constant here; a set-point sent again is recorded with its own.
            speed = v[np.isfinite(v).all(axis=1), 0] / limits.velocity[0]
            assert list(slows_down(speed[strike - begun :], along)) == []

    @pytest.mark.parametrize("part", [0.15, 0.3, 0.45, 0.6, 0.75])
    def test_it_stops_on_a_curved_path(self, cell, begun, tmp_path, part):
        """Everywhere at the limits, where the controller's straight steps leave the path most."""
        middle = cell.initial + 0.4 * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
        corners = [cell.initial, middle, middle + 0.4, cell.initial + 0.3]
        path = plan(corners, cell.joint_limits, fly=1.0)
        strike = begun + round(part * path.duration / cell.period)
        archive = on_ns16(cell, path, tmp_path / "a.mcap", f"lose@{strike}x3", "continue")
        q = archive.columns["commanded_position"]
        planned = path.sample(np.arange(0.0, path.duration, 1e-4))[0]
        off = np.abs(q[np.isfinite(q).all(axis=1)][:, None] - planned[::10]).max(axis=2).min(axis=1)
        assert off.max() < 2.0 * START_TOLERANCE
