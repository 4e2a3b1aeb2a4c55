"""Another host on the controller's network sends packets while a real `hil move` moves the arm."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import cycle
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket

import pytest

from drivers import CyclicPacket, InitPacket
from hil.archive import ArchiveOutcome, open_archive
from hil.control.simulator_process import LOOPBACK, SimulatorProcess, free_port
from tests.hil.fast_cell import fast_cell

pytestmark = pytest.mark.safety

OTHER_HOST = "127.0.0.2"
PATIENCE = 240.0  # s for commands on a loaded computer
INIT = InitPacket.build(2, 2, {}).encode()
PACKETS = [
    *(number.to_bytes(4, "little") + bytes(44) for number in range(1, 10)),
    INIT,
    *(CyclicPacket.zeros(number, 2).encode() for number in range(10, 30)),
    *(bytes(size) for size in (0, 1, 11, 1501, 9000)),
]
"""A session from its start, and datagrams of other lengths."""


@contextmanager
def attacked(port: int) -> Iterator[socket]:
    """Send `PACKETS` to a port from another address, again and again."""
    over = threading.Event()
    with socket(AF_INET, SOCK_DGRAM) as attacker:
        attacker.bind((OTHER_HOST, 0))
        attacker.setblocking(False)

        def send() -> None:
            for packet in cycle(PACKETS):
                if over.wait(0.002):
                    return
                attacker.sendto(packet, (LOOPBACK, port))

        thread = threading.Thread(target=send)
        thread.start()
        try:
            yield attacker
        finally:
            over.set()
            thread.join()


@pytest.mark.slow
def test_other_host_gets_no_reply_and_the_motion_completes(tmp_path: Path) -> None:
    cell = fast_cell(tmp_path)
    port = free_port()
    output = tmp_path / "moved.mcap"
    linked = cell.with_link(transport="udp", host=LOOPBACK, port=port, bind=LOOPBACK)
    cell.path.write_text(linked.text)
    move = (sys.executable, "-m", "hil", "move", str(cell.path), "--joint", "1", "--by", "30")
    with attacked(port) as attacker:
        controller = SimulatorProcess.start(
            cell.path, "--udp", f"{LOOPBACK}:{port}", "--intervals", "1", "--patience", "0.5"
        )
        done = subprocess.run(
            [*move, "--speed", "2", "--yes", "--json", "-o", str(output)],
            capture_output=True, timeout=PATIENCE, check=False,
        )  # fmt: skip
        summary = controller.end()
        with pytest.raises(BlockingIOError):
            attacker.recv(2048)
    assert done.returncode == 0, (json.loads(done.stdout), done.stderr)
    assert summary["replies"] == summary["cycles"]
    assert summary["missed"] == summary["surplus"] == 0
    archive = open_archive(output)
    assert (archive.outcome or ArchiveOutcome()).lost_packets == 0
    texts = " ".join(event.text for event in archive.events)
    assert sum(map(int, re.findall(r"packets foreign: (\d+)", texts))) > 500
