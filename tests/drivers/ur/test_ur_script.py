"""The program's text does what the simulated controller does; it is short and ends by itself."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.ur.registers import (
    ANGLE_REGISTERS,
    CHECK_REGISTER,
    DEMAND_REGISTER,
    NUMBER_REGISTER,
    Demand,
    Ending,
    Stage,
)
from drivers.ur.script import MIN_CONFIRMED_SET_POINTS, STARTING_CYCLES, StreamProgram
from sim_fixtures.ur.program import ProgramConstants, ProgramError, RegisterProgram, Registers

pytestmark = pytest.mark.safety

PROGRAM = StreamProgram(
    token=4711, period=0.002, patience=5, velocity=(3.0,) * 6, deviation=(0.2,) * 6,
    deceleration=20.0,
)  # fmt: skip


def as_python(text: str) -> str:
    """The program as a generator in Python: URScript differs by `end` and by cycles of servoj."""
    lines = []
    for line in text.splitlines():
        body = line.strip()
        if body == "end":
            continue
        body = re.sub(r"servoj\(q, ([^)]*)\)", r"yield servoj(q, \1)", body)
        body = body.replace("lookahead_time", "lookahead")
        lines.append(" " * (len(line) - len(line.lstrip())) + body)
    text = "\n".join(lines)
    # It begins before the first cycle of the test.
    return text.replace("  while ending", "  yield\n  while ending", 1)


class Machine:
    """Registers and arm, with the functions of URScript that the program calls."""

    def __init__(self, program: StreamProgram, number: int = 0) -> None:
        self.inputs, self.outputs = Registers(), Registers()
        write(self.inputs, np.zeros(6), number, Demand.STREAM)
        self.actual = np.zeros(6)
        self.steady = True
        self.calls: list[tuple[str, Any]] = []
        names = {
            "get_target_joint_positions": lambda: [0.0] * 6,
            "get_actual_joint_positions": lambda: self.actual.tolist(),
            "read_input_integer_register": lambda k: self.inputs.ints.get(k, 0),
            "read_input_float_register": lambda k: self.inputs.floats.get(k, 0.0),
            "write_output_integer_register": self.outputs.ints.__setitem__,
            "write_output_float_register": self.outputs.floats.__setitem__,
            "is_steady": lambda: self.steady,
            "servoj": lambda q, **_: self.calls.append(("servoj", list(q))),
            "stopj": lambda a: self.calls.append(("stopj", a)),
            "rtde_set_watchdog": lambda *a: self.calls.append(("watchdog", a)),
        }
        exec(as_python(program.text()), names)  # our own text
        self.running: Iterator[None] = names["hil_stream"]()  # type: ignore[operator]
        self.over = False
        self.cycle()

    def cycle(self) -> None:
        if not self.over:
            try:
                next(self.running)
            except StopIteration:
                self.over = True


def write(
    registers: Registers, q: np.ndarray, number: int, demand: int, check: float = 0.0
) -> None:
    registers.ints.update({NUMBER_REGISTER: number, DEMAND_REGISTER: demand})
    registers.floats.update(dict(zip(ANGLE_REGISTERS, q.tolist(), strict=True)))
    registers.floats[CHECK_REGISTER] = sum(q.tolist()) + number + check


KINDS = (
    "next",
    "next",
    "next",
    "next",
    "next",
    "same",
    "torn",
    "jump",
    "two",
    "end",
    "stop",
    "none",
)


@settings(max_examples=150, deadline=None)
@given(
    kinds=st.lists(st.sampled_from(KINDS), min_size=1, max_size=40),
    before=st.integers(0, MIN_CONFIRMED_SET_POINTS + 3),
    pushed=st.integers(0, 80),
    steady=st.booleans(),
)
def test_the_text_and_the_simulated_program_do_the_same(kinds, before, pushed, steady) -> None:
    machine = Machine(PROGRAM, 7)
    machine.steady = steady
    inputs, outputs = Registers(), Registers()
    write(inputs, np.zeros(6), 7, Demand.STREAM)
    simulated = RegisterProgram(ProgramConstants.of(PROGRAM.text()), inputs, outputs, np.zeros(6))
    number, q = 7, np.zeros(6)
    for place, kind in enumerate(["next"] * before + kinds):
        step = np.array([2e-3, -1e-3, 0.0, 0.0, 1e-3, 3e-3]) * (place > 2)
        demand, check = Demand.STREAM, 0.0
        if kind != "same":
            number += 2 if kind == "two" else 1
            q = q + step * (2 if kind == "two" else 1)
        if kind == "jump":
            q = q + 0.5
        elif kind == "torn":
            check = 1e-3
        elif kind in ("end", "stop", "none"):
            demand = {"end": Demand.END, "stop": Demand.STOP, "none": Demand.NOTHING}[kind]
        for registers in (machine.inputs, inputs):
            write(registers, q, number, demand, check)
        actual = np.full(6, 0.3) if place == before + pushed else q
        machine.actual = actual
        machine.cycle()
        simulated.step(actual, lambda: steady)
        ended = machine.outputs.ints[28] != 0
        assert ended == (simulated.stage == Stage.STOPPING)
        if ended:
            assert machine.outputs.ints[28] == outputs.ints[28]
            break
        assert machine.outputs.ints == outputs.ints
        assert machine.outputs.floats == outputs.floats
        assert machine.calls[-1] == ("servoj", simulated.command.tolist())


def test_it_ends_in_its_own_stop_and_says_so() -> None:
    machine = Machine(PROGRAM)
    write(machine.inputs, np.zeros(6), 1, Demand.END)
    machine.cycle()
    assert machine.over and machine.calls == [("stopj", PROGRAM.deceleration)]
    assert machine.outputs.ints[28] == Ending.ASKED
    assert machine.outputs.ints[25] == Stage.ENDED


def test_registers_of_an_earlier_run_move_nothing() -> None:
    """Inputs keep their value when their writer has gone."""
    machine = Machine(PROGRAM, 900)
    write(machine.inputs, np.full(6, 1.0), 900, Demand.STREAM)
    for _ in range(STARTING_CYCLES + 2):
        machine.cycle()
    assert machine.over and machine.outputs.ints[28] == Ending.NO_START
    assert all(call[1] == [0.0] * 6 for call in machine.calls if call[0] == "servoj")


def test_the_watchdog_is_set_with_the_first_set_point() -> None:
    machine = Machine(PROGRAM)
    machine.cycle()
    assert not [call for call in machine.calls if call[0] == "watchdog"]
    write(machine.inputs, np.zeros(6), 1, Demand.STREAM)
    machine.cycle()
    watchdog = ("watchdog", ("input_int_register_24", 50, "stop"))
    assert [call for call in machine.calls if call[0] == "watchdog"] == [watchdog]


@pytest.mark.parametrize("silence", range(1, 8))
def test_silence_ends_it_after_its_patience(silence: int) -> None:
    machine = Machine(PROGRAM)
    step = np.array([1e-3, 0, 0, 0, 0, 0])
    machine.steady = False
    for number in range(1, MIN_CONFIRMED_SET_POINTS + 20):
        write(machine.inputs, machine.actual + step * (number > 1), number, Demand.STREAM)
        machine.actual = machine.actual + step * (number > 1)
        machine.cycle()
    last = np.array(machine.calls[-1][1])
    for _ in range(silence):
        machine.cycle()
    assert machine.over == (silence >= PROGRAM.patience)
    servoed = [call[1] for call in machine.calls if call[0] == "servoj"]
    bridged = min(silence, PROGRAM.patience - 1)
    assert servoed[-1] == pytest.approx(last + bridged * step)


@pytest.mark.parametrize(
    "text", ["", "def other():\nend\n", "def hil_stream():\n  stopj(1)\nend\n"]
)
def test_another_text_is_refused_by_the_simulated_controller(text: str) -> None:
    with pytest.raises(ProgramError):
        ProgramConstants.of(text)


@pytest.mark.parametrize("leap", [1, 2, 5, 6, 1000, 1 << 23])
def test_a_number_far_ahead_permits_no_further_step(leap: int) -> None:
    """A number may be ahead by what can be missed; a set-point may be away by no more."""
    machine = Machine(PROGRAM)
    for number in range(1, MIN_CONFIRMED_SET_POINTS + 5):
        write(machine.inputs, np.zeros(6), number, Demand.STREAM)
        machine.cycle()
    reach = PROGRAM.velocity[0] * PROGRAM.period * min(leap, PROGRAM.patience)
    for away, ends in ((0.99 * reach, False), (1.05 * reach, True)):
        q = np.array([away, 0, 0, 0, 0, 0])
        machine.actual = q
        write(machine.inputs, q, MIN_CONFIRMED_SET_POINTS + 4 + leap, Demand.STREAM)
        machine.cycle()
        assert machine.over == ends
        if not ends:
            machine = Machine(PROGRAM)
            for number in range(1, MIN_CONFIRMED_SET_POINTS + 5):
                write(machine.inputs, np.zeros(6), number, Demand.STREAM)
                machine.cycle()
    assert machine.outputs.ints[28] == Ending.STEP


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e300])
def test_numbers_that_are_none_move_nothing(value: float) -> None:
    machine = Machine(PROGRAM)
    for number in range(1, MIN_CONFIRMED_SET_POINTS + 5):
        write(machine.inputs, np.zeros(6), number, Demand.STREAM)
        machine.cycle()
    for number in range(MIN_CONFIRMED_SET_POINTS + 5, MIN_CONFIRMED_SET_POINTS + 15):
        write(machine.inputs, np.array([value, 0, 0, 0, 0, 0]), number, Demand.STREAM)
        machine.cycle()
    assert machine.over
    assert all(call[1] == [0.0] * 6 for call in machine.calls if call[0] == "servoj")


def test_it_is_short_and_has_only_known_functions() -> None:
    text = PROGRAM.text()
    assert len(text.splitlines()) < 150 and len(text) < 8000
    assert text.isascii()
    called = set(re.findall(r"\b([a-z_]+)\(", text)) - {"hil_stream"}
    assert called == {
        "get_target_joint_positions", "get_actual_joint_positions", "is_steady", "servoj", "stopj",
        "read_input_integer_register", "read_input_float_register", "rtde_set_watchdog",
        "write_output_integer_register", "write_output_float_register",
    }  # fmt: skip
