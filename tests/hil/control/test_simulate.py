"""`hil simulate` and a foreign PC program, two processes with a network between them."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from multiprocessing import get_context
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import tomlkit
import typer
from typer.testing import CliRunner

from hil.base.errors import InputError
from hil.base.progress import say_at_once
from hil.cell import Cell, CellError
from hil.cli import exit_code_of, main
from hil.cli.simulate import WORDS, PhasePrinter, _sentences, simulate
from hil.control.motion_checks import MotionChecks
from hil.control.simulated_cell import (
    controller_settings,
    own_postures,
    simulated_controller,
    simulated_link,
    with_simulation,
)
from hil.control.simulator_on_link import Buttons, Served, open_controller_link
from hil.control.simulator_process import free_port
from sim_fixtures import ControllerSettings, Phase
from sim_fixtures.ns16 import CELL_PATH
from sim_fixtures.serve import Latencies, Request, ServeCounts

pytestmark = pytest.mark.long

FOREIGN = [sys.executable, str(Path(__file__).parents[1] / "foreign_pc.py")]
SLOW_MACHINE = ["--missed", "300"]
"""Pauses of this computer must not end open mode."""
PATIENT = [*SLOW_MACHINE, "--patience", "0.5"]
"""Nor the start of the session; replies must not be late then."""

OFF, DRIVING, CLOSED, ENDED = (
    f"status {s}, modes {[m] * 6}" for s, m in ((0, 0), (5, 501), (5, 0), (0, 504))
)


def opened(mode: int = 4) -> str:
    return f"status 5, modes {[mode] * 6}"


def link_at(udp: str | None = None, can: str | None = None) -> Any:
    settings = replace(controller_settings(Cell.load(CELL_PATH)), period=0.002)
    return open_controller_link({"--udp": udp, "--can": can}, settings, 6)


@contextmanager
def running(*command: object) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        list(map(str, command)),
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    with watched(process.kill):  # a reader of its output gets an end of file
        yield process
    process.communicate()


@contextmanager
def watched(kill: Callable[[], object]) -> Iterator[None]:
    """Kill after this, and after 40 s in any case."""
    watchdog = threading.Timer(40.0, kill)
    watchdog.start()
    try:
        yield
    finally:
        watchdog.cancel()
        kill()


class Forked:
    """A command of `hil` in a child of this process, which has the imports behind it."""

    def __init__(self, command: list[str]) -> None:
        reading, writing = os.pipe()
        self.process = get_context("fork").Process(target=_be_hil, args=(command, writing))
        self.process.start()
        os.close(writing)
        self.stdout = os.fdopen(reading)

    def finish(self, status: int, timeout: float = 30.0) -> str:
        """Rest of its output; it has to end with this status."""
        output = self.stdout.read()
        self.process.join(timeout)
        assert self.process.exitcode == status, output
        return output

    def signal(self, number: int) -> None:
        os.kill(self.process.pid, number)


def _be_hil(command: list[str], out: int) -> None:
    os.dup2(out, 1)
    os.dup2(out, 2)
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", closefd=False)
    sys.argv = ["hil", *command]
    try:
        main()
    finally:
        sys.stdout.flush()


@contextmanager
def cabinet_at(port: int, *options: str) -> Iterator[Forked]:
    """`hil simulate` on a port of the loopback device."""
    forked = Forked(["simulate", str(CELL_PATH), "--udp", f"127.0.0.1:{port}", *options])
    with watched(forked.process.kill):
        yield forked
    forked.process.join(10)
    forked.stdout.close()


def last_json(text: str) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(text.strip().splitlines()[-1])
    return document


def session(
    controller: list[str], pc: list[str], until: list[str] | None = None
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Accounts of both sides of one session; ended by a signal after the states `until`."""
    port = free_port()
    with running(*FOREIGN, "--port", port, *pc) as program:
        assert "listening" in program.stdout.readline()
        with cabinet_at(port, "--json", *controller) as cabinet:
            wait_for(until or [], program.stdout)
            if until:
                cabinet.signal(signal.SIGTERM)
            output = cabinet.finish(0)
        heard = program.stdout.read()
        assert program.wait(timeout=10) == 0, heard
    return last_json(output), last_json(heard)


def wait_for(states: list[str], lines: Iterable[str]) -> None:
    """Read what the foreign program prints until it has seen these states in this order."""
    missing = list(states)
    while missing:
        line = next(iter(lines), None)
        assert line is not None, f"never seen: {missing}"
        if line.strip().split("  ")[1:2] == missing[:1]:
            missing.pop(0)


@pytest.mark.parametrize(
    ("controller", "pc", "mode"),
    [
        (["--cycle", "2"], ["--manner", "lab"], 4),
        (["--cycle", "1", "--warm-start", "--stagger", "0"], ["--manner", "library"], 4),
        (["--cycle", "2", "--mode", "5", "--stagger", "1"], ["--manner", "library"], 5),
        (["--cycle", "1", "--mode", "7"], ["--manner", "lab"], 7),
    ],
    ids=["2 ms, cold", "1 ms, warm", "mode 5", "mode 7"],
)
def test_a_foreign_program_goes_through_a_whole_session(controller, pc, mode):
    ours, theirs = session(
        [*controller, "--intervals", "1", *PATIENT],
        [*pc, "--exit-after", "500", "--sine-period", "250", "--amplitude", "0.3"],
    )
    story = theirs["story"]
    assert theirs["period_ms"] == int(controller[1])
    if "--warm-start" in controller:
        assert story[:2] == ["init", OFF]
    else:
        assert story[:4] == ["sync", "init", "sync after init", OFF]
        assert (theirs["seen"]["sync"], theirs["seen"]["sync after init"]) == (9, 2)
    stages = [OFF, DRIVING, CLOSED, opened(mode), CLOSED, OFF, ENDED]
    assert [state for state in story if state in stages] == stages
    assert theirs["seen"]["exit asked"] >= 1
    assert theirs["moved"] == pytest.approx(0.3, abs=0.05)
    assert (ours["phase"], ours["intervals"], ours["reason"]) == ("ended", 1, "")
    assert ours["cycles"] == ours["replies"] + ours["missed"]
    assert ours["rejected"] == 0


def test_signals_end_the_session_and_press_buttons():
    """And after 505 the drive stays off without the button."""
    port = free_port()
    with (
        running(*FOREIGN, "--port", port, "--send-505", "20", "--exit-after", "0") as program,
        cabinet_at(port, "--cycle", "2", *PATIENT) as cabinet,
    ):
        wait_for([opened(), OFF], program.stdout)
        cabinet.signal(signal.SIGUSR1)
        wait_for([DRIVING], program.stdout)
        cabinet.signal(signal.SIGUSR2)
        wait_for([OFF], program.stdout)
        cabinet.signal(signal.SIGTERM)
        assert "emergency stop" in cabinet.finish(0)
        assert program.wait(timeout=10) == 0


def test_a_missing_pc_and_an_interrupt_have_an_exit_status():
    with cabinet_at(free_port(), "--json", "--duration", "0.5") as cabinet:
        output = last_json(cabinet.finish(4))
    assert (output["cycles"], output["ended"]) == (0, False)
    with cabinet_at(free_port()) as cabinet:
        next(line for line in cabinet.stdout if "starting" in line)
        cabinet.signal(signal.SIGINT)
        assert "no reply of a PC program" in cabinet.finish(130)


def test_sessions_are_repeated_until_the_end_is_asked_for():
    port = free_port()
    options = ["--cycle", "2", "--intervals", "1", "--repeat", "--json", *PATIENT]
    with cabinet_at(port, *options) as cabinet:
        for _ in range(2):
            with running(*FOREIGN, "--port", port) as program:
                program.communicate(timeout=30)
        cabinet.signal(signal.SIGTERM)
        lines = cabinet.finish(0).strip().splitlines()
    assert [json.loads(line)["intervals"] for line in lines] == [1, 1]


def test_a_program_that_has_ended_costs_one_extension():
    """Not one for each of the thousand cycles until the session is given up."""
    port = free_port()
    with cabinet_at(port, "--cycle", "2", "--patience", "1") as cabinet:
        with running(*FOREIGN, "--port", port) as program:
            wait_for([opened()], program.stdout)
            program.kill()
        began = time.monotonic()
        output = cabinet.finish(0)
    assert time.monotonic() - began < 15.0
    assert output.count("axes opening") <= 3
    assert "time to reply: " in output and " µs median" in output
    assert re.search(r"cycles? extended by up to 1\d{3}\.\d ms", output), output
    for key in ("knocks", "stretched", "_us"):
        assert key not in output


def test_lines_that_come_back_are_collapsed(capfd):
    status = PhasePrinter(ControllerSettings(), quiet=False)
    phases = [Phase.CLOSED, Phase.OPENING] * 50 + [Phase.ENDED]
    for cycle, phase in enumerate(phases):
        status.watch(SimpleNamespace(phase=phase, reason=""), ServeCounts(cycles=cycle))
    printed = capfd.readouterr().out
    assert printed.count("axes opening") == 3
    assert "lines not printed: 94" in printed
    assert printed.strip().endswith("ended")


def test_in_own_motion_the_arm_moves_while_its_axes_are_closed():
    ours, theirs = session(
        ["--cycle", "2", "--own-motion", "--own-speed", "1", *PATIENT],
        [],
        until=["more than one revolution"],
    )
    assert set(theirs["story"]) <= {"sync", "init", "sync after init", OFF, DRIVING, CLOSED, ENDED}
    assert theirs["travel"] > 1.0
    assert (ours["intervals"], ours["reason"]) == (0, "")


def test_the_own_motion_of_the_command_has_no_end(monkeypatch):
    """And where no posture is clear there is none."""
    built = []
    monkeypatch.setattr(
        "hil.cli.simulate.serve_session", lambda build, *_, **__: built.append(build())
    )
    invoke("--udp", "127.0.0.1:2001", "--own-motion")
    settings = built[0].settings
    assert settings.own_motion_repeats
    assert len(settings.own_motion) == 13
    monkeypatch.setattr("hil.cli.simulate.own_postures", lambda _: ())
    result = invoke("--udp", "127.0.0.1:2001", "--own-motion")
    assert isinstance(result.exception, InputError)
    assert "no posture" in str(result.exception)


def test_own_postures_are_within_limits_and_clear_on_the_way():
    cell = Cell.load(CELL_PATH)
    postures = np.array(own_postures(cell))
    limits = cell.joint_limits
    checker = MotionChecks.of(cell).checker
    assert len(postures) == 13
    assert (postures >= limits.lower).all() and (postures <= limits.upper).all()
    assert np.ptp(postures, axis=0).min() >= 0.5
    share = np.linspace(0.0, 1.0, 60)[:, np.newaxis]
    for start, end in pairwise(np.vstack((cell.initial, postures))):
        assert checker.clear(start + share * (end - start)).all()
    assert postures[-1] == pytest.approx(cell.home)


def test_real_hardware_is_simulated_only_where_asked_for():
    real = Cell.load(CELL_PATH).with_link(transport="udp")
    with pytest.raises(CellError, match="real hardware"):
        simulated_link(real)
    assert simulated_link(real, instead_of_hardware=True).is_virtual
    assert simulated_controller(real).period == 0.001


def test_a_cell_without_simulation_has_the_nominal_arm():
    cell = Cell.load(CELL_PATH)
    document = tomlkit.parse(cell.text)
    del document["simulation"]
    document["cell"]["assumed"] = []  # type: ignore[index]
    bare = Cell.from_texts(tomlkit.dumps(document), cell.urdf, cell.path)
    assert bare.file.simulation is None
    simulated = with_simulation(bare)
    assert simulated.simulation.rotor_inertia == cell.nominal.rotor_inertia
    assert simulated.simulation.initial_deg == cell.campaign.home_deg
    assert simulated_controller(simulated).period == cell.period
    assert with_simulation(cell) is cell


def invoke(*options: str) -> Any:
    app = typer.Typer()
    app.command()(simulate)
    return CliRunner().invoke(app, [str(CELL_PATH), *options])


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--can", "virtual:0:fd", "--cycle", "1"], "135.7 % of a cycle of 1 ms"),
        (["--can", "virtual:0:classic"], "classic CAN is no longer supported"),
        (["--can", "virtual:can0:foo"], "INTERFACE:CHANNEL:fd"),
        (["--udp", "127.0.0.1:2001", "--fault", "lose@1x100000000000000000000"], "KIND@CYCLE"),
        ([], "give one of --udp, --can"),
        (["--udp", "127.0.0.1:2001", "--can", "virtual:0"], "give one of"),
        (["--udp", "127.0.0.1"], "HOST:PORT"),
        (["--udp", "no.such.host.invalid:1"], "no such IPv4 host"),
        (["--can", "socketcan"], "INTERFACE:CHANNEL"),
        (["--udp", "127.0.0.1:2001", "--mode", "3"], "open_mode"),
        (["--udp", "127.0.0.1:2001", "--fault", "lose"], "lose@1200x3"),
        (["--udp", "127.0.0.1:2001", "--fault", "lose@1200x3"], "netem"),
        (["--udp", "127.0.0.1:2001", "--fault", "explode@3"], "explode"),
        (["--udp", "127.0.0.1:2001", "--fault", "saturate@3:axis=9"], "axes 1..6"),
    ],
)
def test_impossible_options_are_refused_first(options, complaint):
    result = invoke(*options)
    assert complaint in str(result.exception)
    assert exit_code_of(result.exception) == 2


def test_a_bus_is_named_as_python_can_names_it():
    for text in ("virtual:simulate", "virtual:simulate:fd"):
        link = link_at(can=text)
        assert link.receive(0.001) is None
        link.close()
    with pytest.raises(InputError, match="no-such-bus"):
        link_at(can="no-such-bus:0")


def test_the_first_signal_asks_for_the_end_the_second_aborts():
    """A duration that is over asks for the end, but is no interrupt."""
    assert set(WORDS) == set(Phase)
    buttons = Buttons()
    assert buttons.request() is Request.CONTINUE
    buttons.press(signal.SIGINT)
    assert buttons.request() is Request.END
    buttons.press(signal.SIGTERM)
    assert buttons.request() is Request.ABORT
    buttons = Buttons(duration=0.0)
    assert buttons.request() is Request.END
    assert not buttons.interrupted


def test_a_reader_that_stopped_costs_lines_not_cycles():
    reader, writer = os.pipe()
    try:
        for _ in range(3000):
            say_at_once("x" * 100, writer)  # more than the pipe holds: a blocking write would wait
    finally:
        os.close(reader)
    say_at_once("the reader has gone", writer)
    os.close(writer)


def test_foreign_and_lost_datagrams_are_ignored():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        link = link_at(f"127.0.0.1:{free_port()}")
        other.sendto(b"hello", ("127.0.0.1", link._socket.getsockname()[1]))
        assert link.receive(0.2) is None
        assert link.foreign == 1
    for _ in range(5):  # a PC that does not listen is no error
        link.send(b"anybody there?")
        assert link.receive(0.002) is None
    link.close()
    link = link_at("255.255.255.255:9")  # broadcast is not permitted
    link.send(b"x")
    link.close()


class TestClosing:
    """The last lines of a session: words of a manual, and only counts that are not zero."""

    @staticmethod
    def lines(foreign: int = 0, *, end: str = "replied", **counts: int) -> str:
        controller: Any = SimpleNamespace(reason="", program=SimpleNamespace(end_packet=end))
        summary = ServeCounts(cycles=1164, first_packets=3, replies=1164, ended=True, **counts)
        return "\n".join(_sentences(Served(controller, summary, 1, 1, foreign)))

    def test_of_a_session_without_losses(self) -> None:
        text = self.lines()
        assert "1164 cycles, each with a valid reply in time" in text
        assert not re.search("knock|slip|foreign|surplus|rejected", text)

    def test_of_another_end_than_504(self) -> None:
        assert "the session has ended (504)" in self.lines()
        assert "the session has ended (504, without a reply to it)" in self.lines(end="unanswered")
        assert "the session has ended (without 504)" in self.lines(end="none")

    def test_of_replies_after_their_cycle(self) -> None:
        for counts in ({"extended": 3}, {"read_late": 2}):
            text = self.lines(**counts)
            assert "each with a valid reply in time" not in text
            assert "each with a valid reply" in text
        assert "2 replies arrived in time but were read late" in text

    def test_percentiles_of_long_times_are_not_the_longest(self) -> None:
        times = Latencies()
        for milliseconds in range(1, 101):
            times.add(1e-3 * milliseconds)
        assert 0.049 < times.quantile(0.5) < 1.2 * 0.051
        assert times.largest == 0.1

    def test_of_replies_that_were_of_no_use(self) -> None:
        text = self.lines(2, missed=4, late=1, rejected=3)
        assert "1164 cycles, 4 without a valid reply in time" in text
        assert "replies not used: 1 too late, 3 with a wrong number, length or content" in text
        assert "2 packets from other addresses not read" in text
