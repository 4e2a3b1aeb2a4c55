"""Attacks from the controller's network, while a real `hil move` moves a simulated arm.

A network of three hosts: the PC, the controller, and an attacker, who sends packets from its own
address or from the controller's. Only the controller gets replies; a moving arm continues or stops.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal, Self, TypeAlias

import numpy as np
import pytest

from hil.archive import Archive, open_archive
from hil.cell import Cell
from tests.hil.fast_cell import fast_cell

HOSTS = {"pc": "10.77.0.1", "controller": "10.77.0.2", "attacker": "10.77.0.3"}
SWITCH = "switch"
BROADCAST = "10.77.0.255"


@dataclass(frozen=True)
class Wire:
    prefix: str

    def command(self, host: str, *command: str) -> list[str]:
        return ["ip", "netns", "exec", f"{self.prefix}{host}", *command]

    def start(self, host: str, *command: str, **more: Any) -> subprocess.Popen[bytes]:
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        return subprocess.Popen(self.command(host, *command), env=environment, **more)

    def ports(self, host: str) -> list[int]:
        """Return the open UDP ports of a host."""
        done = subprocess.run(
            self.command(host, "cat", "/proc/net/udp"), capture_output=True, check=True
        )
        lines = done.stdout.decode().splitlines()[1:]
        return [int(line.split()[1].rpartition(":")[2], 16) for line in lines]

    def await_port(self, host: str, port: int, seconds: float) -> bool:
        """Wait until a UDP port of a host is open."""
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            if port in self.ports(host):
                return True
            time.sleep(0.1)
        return False


def missing() -> str:
    """Return why such a network cannot be created here, "" if it can."""
    if shutil.which("ip") is None:
        return "there is no command `ip` (iproute2)"
    name = f"hil{os.getpid()}try"
    done = subprocess.run(["ip", "netns", "add", name], capture_output=True, check=False)
    if done.returncode:
        return f"network namespaces are not permitted ({done.stderr.decode().strip()})"
    _ip(f"netns del {name}")
    return ""


@contextmanager
def wire() -> Iterator[Wire]:
    """Create the network, and remove it at the end."""
    made = Wire(f"hil{os.getpid()}")
    try:
        _make(made.prefix)
        yield made
    finally:
        for host in (*HOSTS, SWITCH):
            subprocess.run(
                ["ip", "netns", "del", made.prefix + host], capture_output=True, check=False
            )


def _make(prefix: str) -> None:
    switch = prefix + SWITCH
    _ip(f"netns add {switch}")
    _ip(f"-n {switch} link add br0 type bridge")
    _ip(f"-n {switch} link set br0 up")
    for host, address in HOSTS.items():
        space, plug = prefix + host, f"to_{host}"[:15]
        _ip(f"netns add {space}")
        _ip(f"-n {switch} link add {plug} type veth peer name eth0 netns {space}")
        _ip(f"-n {switch} link set {plug} master br0")
        _ip(f"-n {switch} link set {plug} up")
        _ip(f"-n {space} addr add {address}/24 brd + dev eth0")
        for device in ("lo", "eth0"):
            _ip(f"-n {space} link set {device} up")


def _ip(words: str) -> None:
    subprocess.run(["ip", *words.split()], capture_output=True, check=True)


pytestmark = pytest.mark.slow

PORT = 2001
PERIOD = 0.002
CONTROLLER = HOSTS["controller"]
WHERE = f"{HOSTS['pc']}:{PORT}"
Process: TypeAlias = "subprocess.Popen[bytes]"
PATIENCE = 240.0  # s for commands on a loaded computer


@pytest.fixture(scope="module")
def net() -> Iterator[Wire]:
    if reason := missing():
        pytest.skip(reason)
    with wire() as made:
        yield made


@dataclass(frozen=True)
class Outcome:
    """Results of the three hosts."""

    move: dict[str, Any]
    code: int
    controller: dict[str, Any]
    attacker: dict[str, Any]
    archive: Archive | None

    @property
    def rejected(self) -> Counter[str]:
        """Packets without a reply by kind, from the archive."""
        assert self.archive is not None
        found: Counter[str] = Counter()
        for event in self.archive.events:
            if match := re.match(r"packets (\w+): (\d+)", event.text):
                found[match[1]] += int(match[2])
        return found


class Hosts:
    """The processes of the three hosts, ended with the block."""

    def __init__(self, net: Wire, folder: Path, attack: Sequence[str], session: Path | None):
        cell = fast_cell(folder)
        linked = cell.with_link(transport="udp", host=CONTROLLER, port=PORT, bind=HOSTS["pc"])
        cell.path.write_text(linked.text)
        self.archive = folder / "moved.mcap"
        self._net, self._cell, self._attack, self._session = net, cell.path, attack, session
        self._started: list[Process] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for process in self._started:
            process.kill()
            process.wait()

    def _start(self, host: str, *command: str) -> Process:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        process = self._net.start(host, sys.executable, "-m", *command, **pipes)
        self._started.append(process)
        return process

    def attacker(self) -> Process:
        """Start the attacker, on the controller's host if it records; it waits for a line."""
        host = "controller" if self._attack[0] == "record" else "attacker"
        known = () if self._session is None else ("--session", str(self._session))
        target = ("--to", WHERE, "--seconds", "600")
        return self._start(host, "tests.untrusted.attacker", *target, *known, *self._attack)

    def controller(self) -> Process:
        """Start the simulated controller, for one motion."""
        return self._start(
            "controller", "hil", "simulate", str(self._cell), "--udp", WHERE, "--intervals", "1",
            "--patience", "0.5", "--duration", "200", "--json",
        )  # fmt: skip

    def pc(self) -> Process:
        """Start a move of the arm by 60 degrees in 7.6 s."""
        return self._start(
            "pc", "hil", "move", str(self._cell), "--joint", "1", "--by", "60", "--speed", "2",
            "--yes", "--json", "-o", str(self.archive),
        )  # fmt: skip

    def moves(self) -> bool:
        """Return whether the motion has begun or is about to."""
        return bool(list(self.archive.parent.glob("moved.mcap*")))

    def start_attack(self, attacker: Process) -> None:
        """Start the attack, from the controller's port if requested."""
        port = 0
        if "--port" in self._attack:
            port = next(filter(None, self._net.ports("controller")))
        assert attacker.stdin is not None
        assert attacker.stdout is not None
        assert attacker.stdout.readline() == b"ready\n"
        attacker.stdin.write(f"{port}\n".encode())
        attacker.stdin.flush()


def output_of(process: Process) -> dict[str, Any]:
    out, errors = process.communicate(timeout=PATIENCE)
    assert out, errors.decode()
    return json.loads(out)


def moved(
    net: Wire,
    folder: Path,
    attack: Sequence[str],
    *,
    session: Path | None = None,
    begins: Literal["listening", "moving", "first"] = "listening",
) -> Outcome:
    """Move the arm under an attack, which begins before there is a controller, or later."""
    with Hosts(net, folder, attack, session) as hosts:
        attacker = hosts.attacker()
        simulated = None if begins == "first" else hosts.controller()
        move = hosts.pc()
        assert net.await_port("pc", PORT, PATIENCE), move.communicate()
        while begins == "moving" and not hosts.moves() and move.poll() is None:
            time.sleep(0.02)
        hosts.start_attack(attacker)
        simulated = simulated or hosts.controller()
        moved = output_of(move)
        if begins == "first":  # it would continue to ask
            simulated.send_signal(signal.SIGINT)
        controller = output_of(simulated)
        attacker.send_signal(signal.SIGTERM)
        attack_result = output_of(attacker)
    archive = open_archive(hosts.archive) if hosts.archive.exists() else None
    return Outcome(moved, move.returncode, controller, attack_result, archive)


@pytest.fixture(scope="module")
def session(net: Wire, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Record a session: sync, init, cyclic packets, motion and end."""
    folder = tmp_path_factory.mktemp("recorded")
    path = folder / "session.bin"
    found = moved(net, folder, ("record",), session=path)
    assert found.code == 0
    assert found.attacker["recorded"] == pytest.approx(found.controller["cycles"], abs=50)
    return path


def require_completed(found: Outcome) -> None:
    """Check that the controller got each reply once, and the motion completed."""
    assert found.code == 0, found.move
    assert found.controller["replies"] == found.controller["cycles"]
    assert found.controller["missed"] == found.controller["surplus"] == 0
    assert found.archive is not None
    assert found.archive.complete
    assert found.archive.outcome is not None
    assert found.archive.outcome.entries["lost_packets"] == "0"


Attack = Callable[..., Outcome]


@pytest.fixture
def attacked(net: Wire, session: Path, tmp_path: Path) -> Attack:
    """Move the arm under an attack with the recorded session."""
    return partial(moved, net, tmp_path, session=session)


OWN = {
    "init packets": ("init", "--rate", "200"),
    "sync packets": ("sync", "--rate", "200"),
    "cyclic packets in a flood": ("cyclic", "--rate", "20000"),
    "a recorded session": ("replay", "--rate", "1000"),
    "packets from the broadcast address": ("init", "--rate", "200", "--as", f"{BROADCAST}:5555"),
    "invalid lengths and fragments": ("odd", "--rate", "500"),
}
UNDER_ANOTHER_PORT = ("--as", f"{CONTROLLER}:5555")


@pytest.mark.parametrize("what", OWN)
def test_other_host_gets_no_reply(what: str, attacked: Attack) -> None:
    found = attacked(OWN[what])
    require_completed(found)
    assert found.rejected["foreign"] > 500
    assert found.attacker["sent"] > 500
    assert found.attacker["answered"] == 0


def test_broadcast_does_not_arrive(attacked: Attack) -> None:
    found = attacked(("init", "--rate", "200", "--to", f"{BROADCAST}:{PORT}"))
    require_completed(found)
    assert found.attacker["sent"] > 500
    assert not found.rejected
    assert found.attacker["answered"] == 0


@pytest.mark.parametrize("what", ["init", "replay"])
def test_other_port_of_the_controller_is_foreign(what: str, attacked: Attack) -> None:
    """A second controller, or a forged address."""
    found = attacked((what, "--rate", "200", *UNDER_ANOTHER_PORT), begins="moving")
    require_completed(found)
    assert found.rejected["foreign"] > 500


def require_stopped(found: Outcome) -> None:
    """Check exit status 4 and an error of one sentence."""
    assert found.code == 4, found.move
    assert found.move["error"]
    assert "\n" not in found.move["error"]


class TestAsController:
    """Packets from the controller's address and port while the arm moves, which look genuine."""

    @pytest.fixture
    def as_controller(self, attacked: Attack, tmp_path: Path) -> Callable[[str], Outcome]:
        """Check that all set-points are within the limits of a stop."""

        def attack(what: str) -> Outcome:
            under = ("--as", f"{CONTROLLER}:1", "--port")
            found = attacked((what, "--rate", "100", *under), begins="moving")
            assert found.archive is not None, found.move
            assert found.archive.complete
            assert found.attacker["sent"] > 20
            limits = Cell.load(tmp_path / "cell.toml").guard_limits
            sent = found.archive.cycles()["commanded_position"]
            assert np.nanmin(sent - limits.lower) >= 0.0
            assert np.nanmax(sent - limits.upper) <= 0.0
            acceleration = limits.acceleration * limits.stop_acceleration
            widest = (limits.velocity, acceleration, limits.jerk * limits.stop_jerk)
            for order, bound in enumerate(widest, 1):
                rates = np.abs(np.diff(sent, order, axis=0)) / PERIOD**order
                assert np.nanmax(rates / bound) <= 1.0
            return found

        return attack

    @pytest.mark.parametrize("what", ["init", "replay"])
    def test_a_start_ends_the_run(self, what: str, as_controller: Attack) -> None:
        found = as_controller(what)
        require_stopped(found)
        assert "the controller restarted" in found.move["error"]

    def test_an_arm_elsewhere_ends_the_run(self, as_controller: Attack) -> None:
        """Later numbers, of when the arm had arrived."""
        found = as_controller("later")
        require_stopped(found)  # by the guard, missed packets, or missing replies
        assert found.move["outcome"] in ("refused", "stopped", "lost")

    def test_invalid_packets_do_not_end_the_run(self, as_controller: Attack) -> None:
        found = as_controller("odd")
        require_completed(found)
        assert found.rejected["malformed"] > 100

    def test_old_numbers_get_no_reply(self, as_controller: Attack) -> None:
        """The controller's own packets get a reply, or the arm is stopped."""
        found = as_controller("cyclic")
        assert found.rejected["stale"] > 20
        if found.code == 0:
            require_completed(found)
        else:
            require_stopped(found)
            assert found.move["outcome"] in ("stopped", "lost")


def test_attacker_that_begins_first_excludes_the_controller(attacked: Attack) -> None:
    found = attacked(("init", "--rate", "200", *UNDER_ANOTHER_PORT), begins="first")
    assert found.attacker["sent"] > 500
    require_stopped(found)
    assert "the controller did not reach drive-on within" in found.move["error"]
    assert found.archive is None
    assert found.controller["replies"] == found.controller["intervals"] == 0
