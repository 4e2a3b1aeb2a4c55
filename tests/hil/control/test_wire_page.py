"""`docs/wire.md`: its exchange, its offsets, and its clients against a simulated controller."""

from __future__ import annotations

import re
import shutil
import struct
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from drivers.c4g_packets import INIT_DTYPE
from hil.cell import Cell
from hil.control.simulated_cell import simulated_controller
from hil.testing import UdpController
from sim_fixtures.ns16 import CELL_PATH
from tests.hil import foreign_pc

ROOT = Path(__file__).parents[3]
PAGE = ROOT / "docs" / "wire.md"
CLIENTS = ROOT / "examples" / "clients"
ONE_INTERVAL = ("--intervals", "1", "--cycle", "2", "--missed", "300")


def test_the_offsets_of_the_init_packet_are_those_of_the_codec() -> None:
    text = PAGE.read_text("utf-8")
    table = text[text.index("## Init packet") : text.index("## Cyclic packet")]
    stated = {
        int(part) for row in re.findall(r"^\| ([\d, ]+) \|", table, re.M) for part in row.split(",")
    }
    assert INIT_DTYPE.fields is not None
    assert stated == {offset for _, offset, *_ in INIT_DTYPE.fields.values()}


def test_the_exchange_of_the_page_takes_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(foreign_pc, "say", lambda _: None)
    page = re.findall(
        r"^\| (\d+) \| `([0-9a-f ]+)` \|.*?\| `([0-9a-f ]+)` \|", PAGE.read_text("utf-8"), re.M
    )
    assert len(page) == 7
    controller = simulated_controller(Cell.load(CELL_PATH))
    options = SimpleNamespace(
        manner="lab", amplitude=0.5, sine_period=500, exit_after=100, send_505=0
    )
    program = foreign_pc.Program(options)  # type: ignore[arg-type]
    number = 0
    while number != 119:
        packet = controller.next_packet()
        assert packet is not None
        reply = program.answer(packet)
        assert reply is not None
        number = struct.unpack_from("<i", packet)[0]
        controller.accept(reply)
    assert len(packet) == 228
    for offset, sent, answered in page:
        for printed, present in ((sent, packet), (answered, reply)):
            words = bytes.fromhex(printed), present[int(offset) : int(offset) + 4]
            if int(offset) < 16:
                assert words[0] == words[1]
            else:  # the last bit of a float may differ between processors
                floats = [struct.unpack("<f", word)[0] for word in words]
                assert floats[0] == pytest.approx(floats[1], rel=1e-5, abs=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("language", ["Python", "C"])
def test_a_client_moves_the_arm_and_ends_with_the_session(tmp_path: Path, language: str) -> None:
    command = [sys.executable, str(CLIENTS / "client.py")]
    if language == "C":
        compiler = shutil.which("cc")
        if compiler is None:
            pytest.skip("no C compiler on this computer")
        command = [str(tmp_path / "client")]
        build = [compiler, "-Wall", "-Wextra", "-Werror", str(CLIENTS / "client.c"), "-lm"]
        subprocess.run([*build, "-o", command[0]], check=True)
    cell = Cell.load(CELL_PATH)
    with UdpController.started(cell, tmp_path, options=ONE_INTERVAL) as controller:
        done = subprocess.run(
            [*command, str(controller.port)], timeout=90.0, capture_output=True, text=True
        )
        summary = controller.finish()
    assert done.returncode == 0, done.stderr
    assert summary["phase"] == "ended"
    assert summary["intervals"] == 1
    assert summary["rejected"] == 0
    assert summary["reason"] == ""
