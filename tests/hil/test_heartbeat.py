"""Signs of life are given only while the supervision itself is alive."""

from __future__ import annotations

from drivers.exchange import NO_SUPERVISOR
from hil.campaign.live_link import STALL, Heartbeat


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def beats_in(heart: Heartbeat, clock: Clock, given: list[float], seconds: float) -> int:
    """How often it beats while so long nothing else happens."""
    before, end = len(given), clock.now + seconds
    while clock.now < end:
        clock.now += 0.05
        heart.look()
    return len(given) - before


def test_beats_end_where_a_motion_is_supervised_and_its_loop_stands_still() -> None:
    clock, given = Clock(), list[float]()
    heart = Heartbeat(lambda: given.append(clock.now), clock)
    assert beats_in(heart, clock, given, 600.0) >= 11_999, "between motions work may take long"
    heart.turn()
    assert beats_in(heart, clock, given, 0.9 * STALL) > 10
    heart.turn()
    beats_in(heart, clock, given, 2.0 * STALL)
    assert clock.now - given[-1] > 0.9 * STALL
    explained = heart.explained(f"the exchange process ended ({NO_SUPERVISOR})")
    assert "looks at the motion (show, request) did not return for 2.0 s" in explained
    heart.turn()
    assert beats_in(heart, clock, given, 0.5) > 5, "and goes on with the loop"
    heart.rest()
    assert beats_in(heart, clock, given, 60.0) >= 1_199


def test_a_program_that_got_no_processor_is_told_so_and_other_ends_are_not_explained() -> None:
    clock = Clock()
    heart = Heartbeat(lambda: None, clock)
    assert heart.explained(NO_SUPERVISOR) == NO_SUPERVISOR
    clock.now += 0.7
    assert "got no processor time for 0.7 s, load average" in heart.explained(NO_SUPERVISOR)
    assert heart.explained("stopped by the operator") == "stopped by the operator"
