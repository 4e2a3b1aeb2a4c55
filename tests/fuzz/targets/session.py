"""A session under any conversation: nothing raised, nothing past the guard, one answer each."""

from __future__ import annotations

import random

from drivers import State
from tests.fuzz.conversation import Conversation
from tests.fuzz.draw import Draw, mutate_bytes
from tests.fuzz.targets import Target


def run(data: bytes) -> bool:
    """One conversation; whether the arm was open in it."""
    talk = Conversation(Draw(data))
    talk.play()
    return bool((talk.ring.rows["state"] == State.OPEN).any())


def seeds() -> list[bytes]:
    """Conversations that begin with a motion in each mode, and go on at random."""
    found = []
    for seed in range(24):
        rng = random.Random(seed)
        head = bytes((seed % 6, seed % 3, seed % 4, seed % 4, seed % 8, 0, 0, 0, 0, 0, 0))
        found.append(head + bytes((1,)) + rng.randbytes(rng.choice((20, 60, 150))))
    return found


TARGET = Target(run, seeds, mutate_bytes, most=400, replayed=60)
