"""Others on the controller's network, while a real `hil move` moves a simulated arm.

Three hosts on a network of their own: the PC, the controller, and a stranger, who sends what he
likes, from his own address or under the controller's. Nobody but the controller is answered; an
arm that moves goes on as if nobody else was there, or comes to rest.
"""

from __future__ import annotations

import json
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hil.archive import Archive, open_archive
from hil.cell.link import with_link
from tests.hil.fast_cell import fast_cell
from tests.strangers.wire import HOSTS, Wire, missing, wire

pytestmark = pytest.mark.slow

PORT = 2001
PERIOD = 0.002
CONTROLLER = HOSTS["controller"]
ATTACKER = (sys.executable, "-m", "tests.strangers.attacker")
PATIENCE = 240.0
"""s for commands to end, on a machine that does other things as well."""


@pytest.fixture(scope="module")
def net() -> Iterator[Wire]:
    if why := missing():
        pytest.skip(why)
    with wire() as made:
        yield made


@dataclass(frozen=True)
class Told:
    """What the three hosts say afterwards."""

    move: dict[str, Any]
    code: int
    controller: dict[str, Any]
    stranger: dict[str, Any]
    archive: Archive | None

    @property
    def rejected(self) -> Counter[str]:
        """Packets without an answer, by kind, as the archive has them."""
        assert self.archive is not None
        found: Counter[str] = Counter()
        for event in self.archive.events:
            if match := re.match(r"(\d+|a|one) (\w+) packets? got no answer", event.text):
                count = int(match[1]) if match[1].isdigit() else 1
                found[match[2]] += count
        return found


def moved(
    net: Wire,
    folder: Path,
    attack: Sequence[str],
    *,
    session: Path | None = None,
    moving: bool = False,
) -> Told:
    """Move the arm by 60 degrees in 7.6 s, under an attack.

    It begins when the PC's port is open, or when the arm moves.
    """
    cell = fast_cell(folder)
    linked = with_link(cell.text, transport="udp", host=CONTROLLER, port=PORT, bind=HOSTS["pc"])
    cell.path.write_text(linked)
    hil = (sys.executable, "-m", "hil")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    where = f"{HOSTS['pc']}:{PORT}"
    target = ("--to", where, "--seconds", "600")
    known = () if session is None else ("--session", str(session))
    host = "controller" if attack[0] == "record" else "stranger"
    stranger = net.start(host, *ATTACKER, *attack, *target, *known, **pipes)
    simulated = net.start(
        "controller", *hil, "simulate", str(cell.path), "--udp", where, "--intervals", "1",
        "--patience", "0.5", "--duration", "200", "--json", **pipes,
    )  # fmt: skip
    out = folder / "moved.mcap"
    move = net.start(
        "pc", *hil, "move", str(cell.path), "--joint", "1", "--by", "60", "--speed", "2", "--yes",
        "--json", "-o", str(out), **pipes,
    )  # fmt: skip
    try:
        assert net.await_port("pc", PORT, PATIENCE), move.communicate()
        assert stranger.stdin is not None
        while moving and not list(folder.glob("moved.mcap*")) and move.poll() is None:
            time.sleep(0.02)
        there = [port for port in net.ports("controller") if port]
        stranger.stdin.write(f"{there[0]}\n".encode())
        stranger.stdin.flush()
        move_said, move_err = move.communicate(timeout=PATIENCE)
        simulated_said, simulated_err = simulated.communicate(timeout=PATIENCE)
        stranger.send_signal(signal.SIGTERM)
        stranger_said, stranger_err = stranger.communicate(timeout=PATIENCE)
    finally:
        for process in (move, simulated, stranger):
            process.kill()
            process.wait()
    assert simulated_said, simulated_err.decode()
    assert stranger_said, stranger_err.decode()
    assert move_said, move_err.decode()
    return Told(
        json.loads(move_said), move.returncode, json.loads(simulated_said),
        json.loads(stranger_said), open_archive(out) if out.exists() else None,
    )  # fmt: skip


@pytest.fixture(scope="module")
def session(net: Wire, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session as it went over the wire: sync, init, cyclic packets, motion and end."""
    folder = tmp_path_factory.mktemp("recorded")
    path = folder / "session.bin"
    told = moved(net, folder, ("record",), session=path)
    assert told.code == 0
    assert told.stranger["recorded"] == pytest.approx(told.controller["cycles"], abs=50)
    return path


def went_on(told: Told) -> None:
    """The controller got each answer once, and the arm went where it was to go."""
    assert told.code == 0, told.move
    assert told.controller["replies"] == told.controller["cycles"]
    assert told.controller["missed"] == told.controller["surplus"] == 0
    assert told.archive is not None
    assert told.archive.complete
    assert told.archive.outcome is not None
    assert told.archive.outcome["lost_packets"] == "0"


OWN = {
    "init packets": ("init", "--rate", "200"),
    "sync packets": ("sync", "--rate", "200"),
    "cyclic packets in a flood": ("cyclic", "--rate", "20000"),
    "a recorded session": ("replay", "--rate", "1000"),
    "lengths that no packet has, and fragments": ("odd", "--rate", "500"),
}


@pytest.mark.parametrize("what", OWN)
def test_another_host_is_counted_and_gets_no_answer(
    what: str, net: Wire, session: Path, tmp_path: Path
) -> None:
    told = moved(net, tmp_path, OWN[what], session=session)
    went_on(told)
    assert told.rejected["foreign"] > 500
    assert told.stranger["answered"] == 0


@pytest.mark.parametrize("what", ["init", "replay"])
def test_another_port_of_the_controllers_address_is_a_stranger_too(
    what: str, net: Wire, session: Path, tmp_path: Path
) -> None:
    """A second controller that starts, or a stranger who writes the controller's address."""
    under = ("--as", f"{CONTROLLER}:5555")
    told = moved(net, tmp_path, (what, "--rate", "200", *under), session=session, moving=True)
    went_on(told)
    assert told.rejected["foreign"] > 500


@pytest.mark.parametrize("what", ["init", "replay", "cyclic", "odd"])
def test_under_the_controllers_own_address_and_port_the_arm_is_still_guarded(
    what: str, net: Wire, session: Path, tmp_path: Path
) -> None:
    """Nothing in the protocol tells such a stranger from the controller: the run may end.

    What is sent keeps the limits all the same, and what is said of it is one sentence.
    """
    under = ("--as", f"{CONTROLLER}:1", "--port")
    told = moved(net, tmp_path, (what, "--rate", "100", *under), session=session, moving=True)
    assert told.code in (0, 4), told.move
    if told.archive is None:
        assert told.code == 4
        return
    speed = np.abs(np.diff(told.archive.cycles()["commanded_position"], axis=0)) / PERIOD
    limit = np.radians([400.0, 400.0])
    assert np.nanmax(speed / limit) <= 1.0


def test_whoever_begins_first_under_the_controllers_address_can_keep_it_out(
    net: Wire, session: Path, tmp_path: Path
) -> None:
    """Then nothing moves, and the command ends with a sentence."""
    under = ("--as", f"{CONTROLLER}:5555")
    told = moved(net, tmp_path, ("init", "--rate", "200", *under), session=session)
    assert told.code in (0, 4), told.move
    if told.archive is None:
        assert told.controller["intervals"] == 0
        assert told.move["error"]
