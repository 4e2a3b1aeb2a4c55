"""A whole session over CAN, paced by its packets, with the simulated NS 16 at the far end."""

from __future__ import annotations

import numpy as np

from drivers import CycleRing, Guard, Session, exchange
from tests.drivers.can_bench import (
    HOME,
    Cycles,
    N,
    PacedByPackets,
    ns16_controller,
    ns16_train,
    virtual_ends,
    wide_limits,
)
from tests.drivers.rig import smooth_move

MOVE = np.array([0.15, -0.1, 0.125, -0.15, 0.1, 0.2])
PERIOD = 0.002


class Run:
    """One session from cold start to its end, paced by its packets."""

    def __init__(self, profile, *, ends=None, cycles=300, lost=(), mode=4, **settings):
        clock = Cycles()
        self.near, self.far = ends or virtual_ends(profile, clock)
        self.controller = ns16_controller(open_mode=mode, **settings)
        self.link = PacedByPackets(self.near, self.far, self.controller, lost=lost, clock=clock)
        self.ring = CycleRing(N, 8192)
        guard = Guard(wide_limits(), PERIOD)
        self.session = Session(ns16_train(), guard, self.ring, settle_cycles=20, mode=mode)
        self.session.request(smooth_move(MOVE, cycles, start=HOME))
        self.events = []
        exchange(self.link, self.session, until=self._until)
        self.link.close()
        self.events += self.session.events()

    def _until(self):
        self.events += self.session.events()
        return self.link.cycle > 5000

    def seen(self, kind):
        return [event for event in self.events if isinstance(event, kind)]

    @property
    def records(self):
        return self.ring.last(self.ring.capacity)
