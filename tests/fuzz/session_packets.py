"""Fuzz the codec and the session: ``python -m tests.fuzz.session_packets --packets 10000000``.

A controller that mostly plays by the rules, so that packets get deep into the session, and now
and then does not: bytes flipped, fields wild, numbers repeated, old or far ahead, lengths wrong,
init and sync packets at any time, axes and drives that go where they like, long silences. Motions
and corrections are good, at the edge of the bounds, and broken.

Packets come in blocks of `BLOCK`, each with a session and a random generator of its own, so a run
can be split with ``--start`` (a multiple of the block), and reports be added up with ``--merge``.
Nothing may be raised; what else must hold is in `Fuzz._after` (every packet) and
`record_laws` (every block).
"""

from __future__ import annotations

import argparse
import json
import math
import random
import struct
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from drivers import CycleRing, Guard, LinkLost, MotionEnded, RequestError, Session, State
from drivers.packets import INIT_LENGTH, cyclic_length
from tests.drivers.rig import START, drive_train, init_packet, limits
from tests.drivers.sources import (
    FAULTS,
    WILD,
    Breaks,
    FedMotion,
    ScriptedCorrection,
    ScriptedMotion,
    at_the_edge,
    smooth,
)
from tests.fuzz.record_laws import POSITION_MODES, Violation, check_records

BLOCK = 10_000
PERIOD = 0.002
N = 6
MODES = (1, 2, 4, 4, 5, 7, 8, 9)
STRANGE_MODES = (0, 1, 2, 3, 4, 5, 7, 8, 9, 10, 14, 500, 501, 502, 504, 505, 506, 508, -1, 1 << 30)
LENGTH = cyclic_length(N)
INIT = init_packet().encode()
OTHER_INIT = init_packet(sample_time=1).encode()
NUMBER = struct.Struct("<i")
BROKEN_INIT = INIT[:12] + NUMBER.pack(99) + INIT[16:]


class Fuzz:
    """One block: one session, one controller, one stream of packets."""

    def __init__(self, seed: int, block: int, tally: Counter[str]) -> None:
        self.rng = random.Random(f"{seed} {block}")
        self.tally = tally
        self.mode = self.rng.choice(MODES)
        self.plan_only = self.rng.random() < 0.5
        self.calm = self.rng.choice((0.86, 0.98, 0.998))
        self.ring = CycleRing(N, BLOCK)
        self.session = Session(
            drive_train(),
            Guard(limits(), PERIOD),
            self.ring,
            mode=self.mode,
            settle_cycles=self.rng.choice((0, 3, 20)),
        )
        self.now = 0.0
        self.number = 0
        self.frame = bytearray(LENGTH)
        words = np.frombuffer(self.frame, np.int32, offset=12).reshape(N, 9)
        self.modes, self.d = words[:, 0], words.view(np.float32)[:, 1:]
        # (status, mode, or modes) of packets to come
        self.script: list[tuple[int, int | list[int]]] = []
        self.last: tuple[bytes, bytes | None] = (b"", None)
        self.prepared = self._prepared()
        self.rest()

    def rest(self) -> None:
        """The arm at rest, where it began."""
        self.d[:] = 0.0
        self.d[:, 0] = self.d[:, 2] = drive_train().motor_revolutions(START)
        self.d[:, 4] = 0.5

    def run(self, packets: int) -> None:
        for _ in range(packets):
            packet = self._next()
            self._exchange(packet)
            if self.session.state is State.ENDED and self.rng.random() < 0.05:
                self._fresh_session()
        check_records(self.ring.drain(), self.mode, self.plan_only, self.tally)

    def _fresh_session(self) -> None:
        check_records(self.ring.drain(), self.mode, self.plan_only, self.tally)
        session = self.session
        self.session = Session(
            drive_train(), Guard(limits(), PERIOD), self.ring, mode=self.mode, settle_cycles=3
        )
        self._count(session)
        self.number, self.script = 0, []

    def _count(self, session: Session) -> None:
        for name in ("answered", "duplicates", "malformed", "stale", "ended", "missed", "refused"):
            self.tally[name] += getattr(session.counters, name)

    def finish(self) -> None:
        self._count(self.session)

    # Packets ------------------------------------------------------------------------------

    def _next(self) -> bytes:
        rng, state = self.rng, self.session.state
        if state is State.SYNC and rng.random() < 0.8:
            if self.number < 9 and rng.random() < 0.5:
                self.number += 1
                return NUMBER.pack(self.number) + bytes(728)
            self.number = 10
            return INIT
        if rng.random() < self.calm:
            return self._regular()
        return rng.choice(self.ODD)(self)

    def _regular(self) -> bytes:
        """The next packet; where nothing is going on, the way into open mode begins."""
        if self.session.state is State.FAULTED and self.rng.random() < 0.2:
            self.script = []
        if not self.script and self.session.state is not State.OPEN:
            self.rest()
            waiting = self.rng.randint(1, 4)
            opening = self._staggered() if self.rng.random() < 0.3 else []
            open_for = self.rng.randint(50, 600)
            self.script = [*[(5, 0)] * waiting, *opening, *[(5, self.mode)] * open_for]
            if self.rng.random() < 0.1:
                self.script[:0] = [(0, 0), (5, 501)]
            self._request()
        if self.script:
            self.frame[4], mode = self.script.pop(0)
            self.modes[:] = mode
        return self._numbered()

    def _staggered(self) -> list[tuple[int, int | list[int]]]:
        """The axes open one after the other, in any order."""
        order = self.rng.sample(range(N), N)
        return [
            (5, [self.mode if order[joint] <= step else 0 for joint in range(N)])
            for step in range(N - 1)
        ]

    def _numbered(self) -> bytes:
        self.number = self.number + 1 if self.number < 0x7FFF else 1
        NUMBER.pack_into(self.frame, 0, self.number)
        return bytes(self.frame)

    def _bytes_flipped(self) -> bytes:
        packet = bytearray(self._numbered())
        for _ in range(self.rng.randint(1, 4)):
            packet[self.rng.randrange(LENGTH)] ^= 1 << self.rng.randrange(8)
        return bytes(packet)

    def _field_wild(self) -> bytes:
        joint, column = self.rng.randrange(N), self.rng.randrange(8)
        kept = self.d[joint, column]
        with np.errstate(all="ignore"):
            self.d[joint, column] = self.rng.choice(WILD)
        packet = self._numbered()
        self.d[joint, column] = kept
        return packet

    def _field_nudged(self) -> bytes:
        joint, column = self.rng.randrange(N), self.rng.randrange(5)
        kept = self.d[joint, column]
        self.d[joint, column] = kept + np.float32(self.rng.gauss(0.0, 1.0))
        packet = self._numbered()
        self.d[joint, column] = kept
        return packet

    def _mode_strange(self) -> bytes:
        kept = self.modes.copy()
        self.modes[self.rng.randrange(N)] = self.rng.choice(STRANGE_MODES)
        packet = self._numbered()
        self.modes[:] = kept
        return packet

    def _modes_strange(self) -> bytes:
        self.script = [(5, self.rng.choice(STRANGE_MODES))] * self.rng.randint(1, 3)
        return self._regular()

    def _end(self) -> bytes:
        if self.rng.random() > 0.01:
            return self._regular()
        self.modes[:] = 504
        return self._numbered()

    def _drive(self) -> bytes:
        self.frame[4 + self.rng.randrange(4)] = self.rng.choice((0, 5, 1, 255))
        self.script = []
        return self._numbered()

    def _again(self) -> bytes:
        return self.last[0] or self._regular()

    def _old(self) -> bytes:
        packet = bytearray(self._numbered())
        number = (self.number - 1 - self.rng.randrange(1, 0x7FFF)) % 0x7FFF + 1
        packet[:4] = NUMBER.pack(number)
        return bytes(packet)

    def _gap(self) -> bytes:
        for _ in range(self.rng.choice((1, 1, 2, 3, 5, 400))):
            self._numbered()
        return self._numbered()

    def _cut(self) -> bytes:
        return self._numbered()[: self.rng.randrange(LENGTH)]

    def _long(self) -> bytes:
        return self._numbered() + self.rng.randbytes(self.rng.choice((1, 504, 505, 972)))

    def _noise(self) -> bytes:
        return self.rng.randbytes(self.rng.choice((0, 3, 4, 12, 48, LENGTH, 732, INIT_LENGTH)))

    def _numbered_noise(self) -> bytes:
        return self._numbered()[:4] + self.rng.randbytes(LENGTH - 4)

    def _init(self) -> bytes:
        if self.rng.random() > 0.1:
            return self._regular()
        self.number, self.script = 10, []
        return self.rng.choice((INIT, INIT, INIT, OTHER_INIT, BROKEN_INIT))

    def _sync(self) -> bytes:
        return NUMBER.pack(self.rng.randrange(1, 14)) + bytes(728)

    def _silence(self) -> bytes:
        if self.rng.random() > 0.1:
            return self._regular()
        self.now += self.rng.choice((0.9, 1.1, 301.0))
        if self.rng.random() < 0.5:
            self.session.tick(self.now)
        return self._regular()

    def _user(self) -> bytes:
        if self.rng.random() < 0.5:
            self.session.stop()
        else:
            self._request()
        return self._regular()

    ODD = (
        *(_bytes_flipped, _field_wild, _field_nudged, _field_nudged, _mode_strange),
        *(_modes_strange, _end, _drive, _again, _again, _old, _gap, _gap, _cut, _long),
        *(_noise, _numbered_noise, _init, _sync, _silence, _user),
    )

    # Motions ------------------------------------------------------------------------------

    def _prepared(self) -> list[np.ndarray]:
        tables = []
        for _ in range(6):
            direction = np.array([self.rng.choice((-1.0, 0.0, 1.0)) for _ in range(N)])
            if self.rng.random() < 0.6:
                tables.append(smooth(self.rng.randint(80, 400), 0.1 * direction))
            else:
                share = self.rng.choice((0.5, 0.99999, 1.0, 1.00001, 1.1))
                tables.append(at_the_edge(self.rng.randint(1, 41), share, direction))
        return tables

    def _request(self) -> None:
        rng = self.rng
        fault = rng.choice(FAULTS) if rng.random() < 0.3 else ""
        breaks = Breaks(fault, rng.randrange(100), rng.randrange(N), rng.choice(WILD))
        rows = rng.choice(self.prepared)
        try:
            if self.mode in POSITION_MODES or rng.random() < 0.02:
                velocity = np.diff(rows, axis=0, prepend=rows[:1]) / PERIOD
                kind = FedMotion if rng.random() < 0.2 else ScriptedMotion
                bounds = "plan" if self.plan_only else "stop"
                self.session.request(kind(rows, velocity, breaks, bounds))
            else:
                rows = np.vstack([rows, rows[::-1]])
                motion = rows if self.mode != 9 else rows * 0.0
                current = 10.0 * rows if self.mode in (2, 9) else rows * 0.0
                self.session.request(ScriptedCorrection(motion, current, breaks))
        except RequestError:
            self.tally["requests refused"] += 1

    # Outcomes -----------------------------------------------------------------------------

    def _exchange(self, packet: bytes) -> None:
        self.now += PERIOD
        try:
            reply = self.session.reply(packet, self.now)
        except Exception as error:
            raise Violation(f"reply raised {type(error).__name__}: {error}") from error
        for event in self.session.events():
            if isinstance(event, MotionEnded):
                self.tally[f"motion {event.outcome}"] += 1
            elif isinstance(event, LinkLost):
                # Whatever comes after a silence is new, even the same bytes.
                self.tally["links lost"] += 1
                self.last = (b"", None)
        self.tally[f"state {self.session.state.name.lower()}"] += 1
        self._after(packet, reply)
        self.last = (packet, reply) if reply is not None else self.last

    def _after(self, packet: bytes, reply: bytes | None) -> None:
        if reply is None:
            return
        number, answered = NUMBER.unpack_from(packet)[0], NUMBER.unpack_from(reply)[0]
        if answered != (1 if number == 0x7FFF else number + 1):
            raise Violation(f"number {number} answered by {answered}")
        state = self.session.state
        if packet == self.last[0] and reply != self.last[1]:
            raise Violation("a duplicate was answered otherwise")
        if state is State.SYNC or state is State.INIT:
            if reply[4:] != packet[4:]:
                raise Violation("not an echo")
            return
        if len(reply) != LENGTH:
            raise Violation(f"{len(reply)} bytes")
        block = np.frombuffer(reply, np.int32, offset=12).reshape(N, 9)
        mode = block[0, 0]
        values = block.view(np.float32)[:, 1:]
        if state is State.OPEN:
            if not np.isfinite(values).all():
                raise Violation("a set-point that is not finite")
            if self.mode in POSITION_MODES and self.rng.random() < 0.98:
                self.d[:, :4] = values[:, [0, 1, 0, 1]]
        elif state is State.FAULTED and mode in (505, 508) and not np.isfinite(values).all():
            raise Violation("a refusal that is not finite")
        elif reply[4] == 1:
            self.script, self.d[:, [1, 3]] = [(5, 0)] * 2, 0.0


def fuzz(packets: int, seed: int, start: int = 0) -> dict[str, Any]:
    """Run packets start .. start + packets of the stream of this seed; the report.

    Raises:
        Violation: says in which block of which seed.
    """
    if start % BLOCK:
        raise ValueError(f"start {start} is not a multiple of {BLOCK}")
    tally: Counter[str] = Counter()
    begun = time.perf_counter()
    for first in range(0, packets, BLOCK):
        block = (start + first) // BLOCK
        try:
            story = Fuzz(seed, block, tally)
            story.run(min(BLOCK, packets - first))
            story.finish()
        except Violation as violation:
            raise Violation(f"seed {seed}, block {block}: {violation}") from violation
    seconds = time.perf_counter() - begun
    return {"packets": packets, "seconds": seconds, "violations": 0, **dict(sorted(tally.items()))}


def merge(reports: list[dict[str, Any]]) -> dict[str, Any]:
    """The sum of reports of different pieces."""
    total: Counter[str] = Counter()
    for report in reports:
        total.update(report)
    return dict(total)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--packets", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--start", type=int, default=0, help=f"a multiple of {BLOCK}")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--merge", nargs="+", type=Path, help="add up JSON reports instead")
    given = parser.parse_args(arguments)
    if given.merge:
        report = merge([json.loads(path.read_text()) for path in given.merge])
    else:
        report = fuzz(given.packets, given.seed, given.start)
    rate = report["packets"] / max(report["seconds"], math.ulp(1.0))
    if given.json:
        sys.stdout.write(json.dumps({**report, "packets_per_s": rate}) + "\n")
    else:
        lines = [f"{name:>20} {value:,.0f}" for name, value in report.items()]
        sys.stdout.write("\n".join([*lines, f"{'packets per s':>20} {rate:,.0f}"]) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
