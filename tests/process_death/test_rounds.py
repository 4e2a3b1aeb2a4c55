from __future__ import annotations

from typing import get_args

from tests.process_death.rounds import VICTIMS, Moment, drawn


def test_a_round_is_known_by_its_number() -> None:
    assert drawn(417) == drawn(417)
    assert len({str(drawn(number)) for number in range(200)}) > 190


def test_victims_come_in_turn_and_nobody_dies_twice() -> None:
    rounds = [drawn(number) for number in range(400)]
    assert [one.victims[0] for one in rounds[:4]] == list(VICTIMS)
    assert all(len(set(one.victims)) == len(one.victims) for one in rounds)


def test_every_moment_and_every_pair_is_among_a_thousand_rounds() -> None:
    rounds = [drawn(number) for number in range(1000)]
    moments = {one.trigger.moment for one in rounds}
    assert moments == set(get_args(Moment))
    pairs = {one.victims[:2] for one in rounds if len(one.victims) > 1}
    assert len(pairs) == len(VICTIMS) * (len(VICTIMS) - 1)
