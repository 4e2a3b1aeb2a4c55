"""A heartbeat that stands still is told from one that nobody could see."""

from __future__ import annotations

import pytest

from hil.archive.pulse import Pulse


class Machine:
    """A clock, and another process's heartbeat."""

    def __init__(self, beat: float = 1.0) -> None:
        self.now, self.beat = 100.0, beat
        self.pulse = Pulse(lambda: self.beat, lambda: self.now)

    def watch(self, seconds: float, *, beating: bool = False) -> float:
        """Look each 0.1 s; the last quiet time seen."""
        quiet = 0.0
        for _ in range(round(seconds / 0.1)):
            self.now += 0.1
            self.beat += beating
            quiet = self.pulse.quiet()
        return quiet


def test_a_living_process_is_never_quiet() -> None:
    assert Machine().watch(10.0, beating=True) == 0.0


def test_silence_is_counted_and_ends_with_the_next_beat() -> None:
    machine = Machine()
    assert machine.watch(6.0) == pytest.approx(6.0)
    assert machine.watch(0.1, beating=True) == 0.0


def test_a_machine_that_was_suspended_does_not_take_everybody_for_dead() -> None:
    machine = Machine()
    machine.now += 3600.0
    assert machine.pulse.quiet() <= 0.5


def test_a_process_that_has_not_begun_is_not_quiet_yet() -> None:
    assert Machine(beat=0.0).watch(10.0) == 0.0
