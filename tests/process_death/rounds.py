"""Rounds of kills, random by their number: which process is killed, when, and what follows."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Final, Literal

from drivers.states import State
from sim_fixtures.settings import WHILE_SILENT, WhileSilent
from tests.faults import Moment, Strikes, Trigger, Victim

LinkName = Literal["udp", "rtde"]
"""Links whose processes are killed: of a C4G, and of a UR."""
VICTIMS: Final[tuple[Victim, ...]] = ("exchange", "archive", "supervisor", "controller")
OVER_SOCKETS: Final = 10
"""Every so many rounds the campaign is finished over sockets again, and not in virtual time."""
LOOPS: Final = 0.04
"""Share of the rounds in which the exchange has to end by its own patience, which takes it 10 s."""
EARLY: Final = ("start", "cycle")
MINUTES: Final = 0.1
"""Share of the early deaths of a controller that are played: a supervisor waits a minute for a
drive to be switched on."""
CYCLES: Final = 150  # Cycles within which the controller has begun, and switched its drive on
LONGEST: Final[dict[LinkName, float]] = {"udp": 0.8, "rtde": 1.5}
"""Time that the longest motion of the cell takes, s."""
REPORTED: Final = 0.07  # s between two moments at which the exchange reports the motion time
ARCHIVES: Final = 6
"""Archives of a whole campaign: two moves, standstill, two repetitions, validation."""
STATES: Final = (State.CLOSED, State.OPENING, State.OPEN, State.EXITING)


@dataclass(frozen=True)
class Round:
    """What happens in one round."""

    link: LinkName  # of the campaign
    number: int  # of the round, and its seed
    strikes: Strikes  # who is killed, and when
    over_sockets: bool  # whether the campaign is finished over sockets, with a new controller
    loops: bool  # whether the controller's program opens the axes again and again
    while_silent: WhileSilent
    missed_replies: int
    stagger: int  # how the controller behaves; see `sim_fixtures.ControllerSettings`

    @property
    def seed(self) -> int:
        """Seed of the controller's noise and parameters, never 0; repetitions have the same."""
        return 1 + self.number

    def __str__(self) -> str:
        return f"{self.link} round {self.number}: {', '.join(self.strikes.lines)}"


def round_of(number: int, link: LinkName = "udp") -> Round:
    """Return the round of that number; the first victims alternate, everything else is random."""
    chance = random.Random(f"process death {number}")
    longest = LONGEST[link]
    first = VICTIMS[number % len(VICTIMS)]
    others = [victim for victim in VICTIMS if victim != first]
    more = chance.choices((0, 1, 2), (8, 2, 1))[0]
    victims = (first, *chance.sample(others, more))
    trigger = _trigger(chance, longest)
    while "controller" in victims and trigger.moment in EARLY and chance.random() > MINUTES:
        trigger = _trigger(chance, longest)
    apart = chance.choice((0.0, chance.uniform(0.0, 0.05), chance.uniform(0.0, 0.6)))
    return Round(
        link=link,
        number=number,
        strikes=Strikes("kill", trigger, victims, apart if more else 0.0),
        over_sockets=number % OVER_SOCKETS == 0,
        loops=chance.random() < LOOPS,
        while_silent=chance.choice(WHILE_SILENT),
        missed_replies=chance.choice((1, 5, 50)),
        stagger=chance.randrange(6),
    )


def _trigger(chance: random.Random, longest: float) -> Trigger:
    moment: Moment = chance.choices(
        ("start", "cycle", "motion", "archive", "entered", "state"), (1, 1, 8, 4, 3, 5)
    )[0]
    if moment == "start":
        return Trigger(moment, 0, chance.uniform(0.0, 1.5))
    if moment == "cycle":
        return Trigger(moment, chance.randrange(CYCLES), chance.uniform(0.0, 0.002))
    if moment == "motion":
        way = chance.uniform(0.0, longest)
        return Trigger(moment, chance.randint(1, ARCHIVES), chance.uniform(0.0, REPORTED), way)
    if moment == "archive":
        return Trigger(moment, chance.randint(1, ARCHIVES), chance.expovariate(10.0))
    if moment == "entered":
        return Trigger(moment, chance.randint(1, ARCHIVES - 1), chance.expovariate(100.0))
    count = chance.randint(1, ARCHIVES)
    delay = chance.expovariate(50.0)
    return Trigger(moment, count, delay, state=chance.choice(STATES))
