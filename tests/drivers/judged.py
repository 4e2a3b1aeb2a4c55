"""One session's packets, each delivered and its outcome judged from outside.

What must hold is in `reception` (which packets are answered), `judge` (what open axes are told) and
`oracle` (the bytes).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from drivers import CycleRing, InitReceived, MotionEnded, Session
from tests.drivers import oracle
from tests.drivers.judge import Conduct
from tests.drivers.reception import Reception, number_of

SILENCE = 301.0
"""s: longer than any silence may last."""


class Judged:
    """What a drawn conversation is made of; whoever draws says `hear` once, then `deliver`.

    Attributes:
        last: the packet answered afresh last, and its answer.
        now: s, when the packet delivered last arrived.
        ages: of the values in the next packet, as `Session.reply` takes them.
    """

    def hear(
        self,
        session: Session,
        ring: CycleRing,
        conduct: Conduct,
        *,
        n_axes: int,
        max_gap: int,
        silence: float,
        period: float,
        inits: Mapping[bytes, bool],
    ) -> None:
        """Begin; `inits` are init packets of which it is known whether the arm may be moved."""
        self.session, self.ring, self.conduct = session, ring, conduct
        self.reception = Reception(silence)
        self.max_gap = max_gap
        self._n_axes, self._period, self._inits = n_axes, period, inits
        self.now = 0.0
        self.last: tuple[bytes, bytes] | None = None
        self.ages: np.ndarray[Any, Any] | None = None
        self.unanswered = 0

    def deliver(self, packet: bytes, elapsed: float | None = None) -> bytes | None:
        """One packet, and its answer judged.

        Raises:
            AssertionError: a law is broken.
        """
        elapsed = self._period if elapsed is None else elapsed
        self.now += elapsed
        if elapsed > SILENCE:
            self.silence_heard()
        before, last = self.ring.slot, self.reception.last
        kind = self.reception.expect(packet)
        reply = self.session.reply(packet, self.now, self.ages)
        self.take_events()
        rows = self.ring.slot - before
        assert rows == (kind == "cyclic") or (kind == "cyclic" and rows < 0), "records"
        if kind == "nothing":
            assert reply is None, "an answer to what gets none"
            self.unanswered += 1
            return None
        assert reply is not None, f"no answer to {kind}"
        if kind == "again":
            assert self.last is not None and reply == self.last[1], "a duplicate answered otherwise"
            return reply
        self.last = packet, reply
        if kind == "cyclic":
            self._cyclic(packet, reply, last)
            return reply
        assert reply == oracle.echo(packet), "not an echo"
        self.conduct.interrupted()
        return reply

    def _cyclic(self, packet: bytes, reply: bytes, last: int) -> None:
        assert len(reply) == oracle.length(self._n_axes), "length"
        record = self.ring.last(1)[0]
        # Packets that got no answer are gaps to the controller.
        long_gap = record["gap"] + self.unanswered > self.max_gap
        conduct = self.conduct
        conduct.aged = self.ages is not None and bool(self.ages[list(conduct.slots), 0].any())
        conduct.judge(packet, reply, record, bool(long_gap))
        self.unanswered = 0
        missed = (number_of(packet) - last) % 0x7FFF - 1
        assert record["gap"] in (missed, 0), "the gap recorded"
        if all(axis.mode == 504 for axis in oracle.parse(packet, self._n_axes).axes):
            self.reception.ended = True

    def silence_heard(self) -> None:
        """More time has passed than any silence is allowed to take."""
        if not self.reception.ended:
            self.reception.silent = self.reception.n_axes is not None
            self.conduct.interrupted()

    def take_events(self) -> None:
        """What the session says of itself: which motions ended, and which arms are moved."""
        for event in self.session.events():
            if isinstance(event, MotionEnded):
                self.conduct.entitled = False
                self.conduct.stopping = self.conduct.overridden = False
            if isinstance(event, InitReceived):
                self.conduct.usable = event.unusable is None
                fits = self._inits.get(event.init.encode())
                assert fits in (None, self.conduct.usable), "which arms are moved"
