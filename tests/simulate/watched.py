"""Controller, link and session of a simulated campaign, with recorders."""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from functools import partial
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import CycleRing, Session
from drivers.transports.simulated import Fault as LinkFault
from drivers.transports.simulated import SimulatedTransport
from hil.campaign import VirtualLink
from sim_fixtures import Phase, SimulatedController
from sim_fixtures.faults import InjectedFault
from tests.faults import Script
from tests.simulate.observed import Act, ArmHistory, Exchanged

Array = NDArray[np.float64]
LONGEST_STALL = 1.0  # s


class WatchedController:
    """A controller with its scripted faults and its history over all processes of the PC."""

    def __init__(self, controller: SimulatedController, script: Script) -> None:
        self.controller = controller
        self.period = controller.period
        self.cycle = 0
        self.struck: list[str] = []
        self._faults: dict[int, list[tuple[str, InjectedFault]]] = {}
        for line, fault in script.faults:
            if not isinstance(fault, LinkFault):
                self._faults.setdefault(fault.cycle, []).append((line, fault))
        self._sent: list[bytes] = []
        self._position: list[Array] = []
        self._velocity: list[Array] = []
        self._phase: list[str] = []
        self._open: list[bool] = []

    @property
    def ended(self) -> bool:
        return self.controller.phase is Phase.ENDED

    def next_packet(self) -> bytes | None:
        for line, fault in self._faults.get(self.cycle, ()):
            fault.apply_to(self.controller)
            self.struck.append(line)
        packet = self.controller.next_packet()
        if packet is None:
            return None
        self.cycle += 1
        plant = self.controller.plant
        self._sent.append(packet)
        self._position.append(plant.position.copy())
        self._velocity.append(plant.velocity.copy())
        self._phase.append(self.controller.phase.name)
        self._open.append(any(self.controller.program.open_axes))
        return packet

    def accept(self, reply: bytes | None) -> None:
        self.controller.accept(reply)

    def alone(self, cycles: int) -> None:
        """Simulate some cycles without a PC."""
        for _ in range(cycles):
            if self.next_packet() is None:
                return
            self.accept(None)

    def press(self, *, restart: bool, warm: bool) -> None:
        """Switch the drive on, after a restart of the controller if requested."""
        if restart:
            self.controller.restart(warm=warm)
        self.controller.drive_on()

    def history(self) -> ArmHistory:
        n = self.controller.plant.position.size
        return ArmHistory(
            sent=tuple(self._sent),
            position=np.array(self._position).reshape(-1, n),
            velocity=np.array(self._velocity).reshape(-1, n),
            phase=tuple(self._phase),
            open_axes=np.array(self._open, dtype=bool),
        )


class Clock:
    """The PC's clock with scripted jumps, over all lives."""

    def __init__(self, script: Script) -> None:
        jumps = sorted(
            (event.at, event.value, event.line)
            for event in script.of("cycle")
            if event.kind == "clock"
        )
        self._at = [at for at, _, _ in jumps]
        self._offset: list[float] = [0.0, *accumulate(value for _, value, _ in jumps)]
        self._lines = [line for _, _, line in jumps]
        self.struck: list[str] = []

    def offset(self, cycle: int) -> float:
        """Return the sum of the jumps up to a cycle [s]."""
        if not self._at:
            return 0.0
        passed = bisect_right(self._at, cycle)
        if passed > len(self.struck):
            self.struck = self._lines[:passed]
        return self._offset[passed]


class WatchedTransport(SimulatedTransport):
    """A simulated transport with stalls and clock faults that records all packets.

    `on_cycle` is called with the present cycle before each packet is received; it may raise.
    """

    def __init__(
        self, peer: WatchedController, script: Script, clock: Clock, on_cycle: Callable[[int], None]
    ) -> None:
        faults = [fault for _, fault in script.faults if isinstance(fault, LinkFault)]
        self._inner = SimulatedTransport(peer, faults)
        self._inner.cycle = peer.cycle
        self._clock = clock
        self._on_cycle = on_cycle
        self._period = peer.period
        stalls = (
            event
            for event in script.of("cycle")
            if event.kind == "stall" and event.at >= peer.cycle
        )
        self._stalls = deque(sorted(stalls, key=lambda stall: stall.at))
        self._held: deque[tuple[float, bytes]] = deque()
        self._arrival = -math.inf
        self.struck: list[str] = []
        self.answering = -1  # index in `seen` of the packet that the session processes
        self.seen: list[tuple[float, int, bytes, list[bytes]]] = []  # time, cycle, packet, replies

    @property
    def now(self) -> float:
        return self._inner.now + self._clock.offset(self._inner.cycle)

    @property
    def at(self) -> int:
        return self._inner.cycle

    def receive(self, timeout: float) -> bytes | None:
        self._on_cycle(self._inner.cycle)
        self._stall("")
        if self._held:
            self._arrival, packet = self._held.popleft()
        else:
            received = self._inner.receive(timeout)
            if received is None:
                return None
            self._arrival = self._inner.now
            packet = received
        self.seen.append((self.now, self._inner.cycle - 1, packet, []))
        return packet

    def send(self, packet: bytes) -> None:
        self.seen[self.answering][3].append(packet)
        self._stall("answering")
        self._inner.send(packet)

    def close(self) -> None:
        self._inner.close()

    def _stall(self, where: str) -> None:
        """Execute the next stall if it is due; packets accumulate meanwhile."""
        if not self._stalls or self._stalls[0].at > self._inner.cycle:
            return
        if self._stalls[0].word != where:
            return
        stall = self._stalls.popleft()
        self.struck.append(stall.line)
        until = self._inner.now + min(stall.value, LONGEST_STALL)
        while (left := until - self._inner.now) > 0.0:
            packet = self._inner.receive(left)
            if packet is not None:
                self._held.append((self._inner.now, packet))


class StampedWatchedTransport(WatchedTransport):
    """A `WatchedTransport` with times of arrival, as UDP has them."""

    @property
    def arrived(self) -> float:
        return min(self.now, self._arrival + self._clock.offset(self._inner.cycle))


class SessionLog:
    """Recorder of the calls, events and records of a session."""

    def __init__(self, link: VirtualLink, transport: WatchedTransport) -> None:
        self._transport = transport
        self._seen = transport.seen
        self.acts: list[Act] = []
        self.events: list[tuple[int, Any]] = []
        self._rows: list[bytes] = []
        self._of: dict[int, int] = {}
        self._given: set[int] = set()
        self._dtype = link.port.ring.rows.dtype
        self._tap(link.port.ring, "commit", self._commit)
        for name in ("request", "stop", "override", "hold", "resume", "discarded"):
            self._tap(link.port.session, name, self._act)
        for name in ("tick", "reply", "events"):
            self._tap(link.port.session, name, getattr(self, f"_{name}"))

    def _tap(self, owner: Any, name: str, instead: Callable[..., Any]) -> None:
        setattr(owner, name, partial(instead, owner, getattr(owner, name)))

    def _commit(self, ring: CycleRing, commit: Callable[[], None]) -> None:
        slot = ring.slot
        self._of[self._transport.answering] = len(self._rows)
        self._rows.append(ring.rows[slot : slot + 1].tobytes())
        commit()

    def _act(self, session: Session, called: Callable[..., None], *arguments: Any) -> None:
        called(*arguments)
        act = Act(self._transport.answering + 1, called.__name__, arguments)
        if not (self.acts and act.name == "stop" and self.acts[-1][1:] == act[1:]):
            self.acts.append(act)

    def _tick(self, session: Session, tick: Callable[[float], None], now: float) -> None:
        before = session.deadline
        tick(now)
        if math.isfinite(before) and not math.isfinite(session.deadline):
            self.acts.append(Act(self._transport.answering + 1, "tick", (now,)))

    def _reply(self, session: Session, reply: Any, packet: bytes, *arguments: Any) -> bytes | None:
        """Find the packet among those received: the session skips superseded ones."""
        row = self._transport.answering + 1
        while row < len(self._seen) and self._seen[row][2] is not packet:
            row += 1
        assert row < len(self._seen), "the session was given a packet that was not received"
        self._transport.answering = row
        self._given.add(row)
        answer: bytes | None = reply(packet, *arguments)
        return answer

    def _events(self, session: Session, events: Callable[[], list[Any]]) -> list[Any]:
        fresh = events()
        self.events += [(self._transport.answering, event) for event in fresh]
        return fresh

    @property
    def exchanged(self) -> tuple[Exchanged, ...]:
        return tuple(
            Exchanged(
                now, cycle, packet, tuple(replies), self._of.get(index, -1), index in self._given
            )
            for index, (now, cycle, packet, replies) in enumerate(self._seen)
        )

    @property
    def records(self) -> NDArray[np.void]:
        return np.frombuffer(b"".join(self._rows), self._dtype)
