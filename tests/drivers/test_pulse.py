"""A heartbeat that stands still is told from one that nobody could see."""

from __future__ import annotations

import time

import pytest

from drivers.exchange.control import LONGEST_LOOK, Pulse


class Machine:
    """A clock, and another process's heartbeat."""

    now, beat = 100.0, 1.0

    def watch(self, pulse: Pulse, seconds: float, *, beating: bool = False) -> float:
        """Look each 0.1 s; the last quiet time seen."""
        quiet = 0.0
        for _ in range(round(seconds / 0.1)):
            self.now += 0.1
            self.beat += beating
            quiet = pulse.quiet()
        return quiet


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> Machine:
    machine = Machine()
    monkeypatch.setattr(time, "monotonic", lambda: machine.now)
    return machine


def test_a_living_process_is_never_quiet(machine: Machine) -> None:
    assert machine.watch(Pulse(lambda: machine.beat), 10.0, beating=True) == 0.0


def test_silence_is_counted_and_ends_with_the_next_beat(machine: Machine) -> None:
    pulse = Pulse(lambda: machine.beat)
    assert machine.watch(pulse, 6.0) == pytest.approx(6.0)
    assert machine.watch(pulse, 0.1, beating=True) == 0.0


@pytest.mark.parametrize("longest", [LONGEST_LOOK, 0.1])
def test_a_machine_that_was_suspended_takes_nobody_for_dead(
    machine: Machine, longest: float
) -> None:
    pulse = Pulse(lambda: machine.beat, longest_look=longest)
    machine.now += 3600.0
    assert pulse.quiet() == longest


def test_a_process_that_has_not_begun_is_not_quiet_yet(machine: Machine) -> None:
    machine.beat = 0.0
    assert machine.watch(Pulse(lambda: machine.beat), 10.0) == 0.0
