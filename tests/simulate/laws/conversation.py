"""Packets and answers of a process life, classified and divided into sessions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from drivers.events import Event, InitReceived
from tests.drivers import oracle
from tests.drivers.oracle import LAST, Kind, Reception, number_of
from tests.simulate.observed import Exchanged, Life, Observed

from .wire import CLOSED, PAUSES, Flags, Init, Packets

INIT_TIMEOUT = 300.0
SILENCE_TIMEOUT = 1.0  # s; defaults of a session
_RECENT = 200  # packets among which duplicates are searched
_END = (504).to_bytes(4, "little")
_PAUSED = tuple(mode.to_bytes(4, "little") for mode in PAUSES)
_KNOWN = {*oracle.OPEN, *CLOSED, *PAUSES}


@dataclass(frozen=True, eq=False)
class Talk:
    """The cyclic packets of one session with the controller, up to the next init packet."""

    life: Life
    init: Init
    usable: bool  # whether the arm may be moved
    events: tuple[Event, ...]  # in order
    at: int  # index of the init packet in `life.exchanged`
    index: NDArray[np.intp]  # (m,) index of each packet there
    silent: Flags  # (m,) whether a silence preceded the packet
    received: Packets
    answer: Packets

    @cached_property
    def record(self) -> NDArray[np.intp]:
        """(m,) row of each packet in `life.records`."""
        return np.array([self.life.exchanged[i].record for i in self.index], np.intp)

    @cached_property
    def records(self) -> NDArray[np.void]:
        """(m,) record of each packet."""
        return self.life.records[self.record]

    def at_cycle(self, cycle: int) -> int:
        """Return the index of the exchanged packet of a cycle, or of the next one."""
        row = int(np.searchsorted(self.records["cycle"], cycle))
        return int(self.index[row]) if row < len(self.index) else len(self.life.exchanged)


@dataclass(frozen=True, eq=False)
class Heard:
    """Classification of one process life."""

    talks: tuple[Talk, ...]  # sessions
    kinds: tuple[Kind, ...]  # kind of the required answer of each packet
    wrong: tuple[tuple[int, str], ...]  # index of a packet and the error of its answer
    left_out: tuple[int, ...]  # indices of packets superseded by a newer one
    fates: Counter[Kind]  # number of packets of each kind
    repeated: int  # superseded packets that are duplicates
    missed: int  # packets that did not arrive or were not answered, by their numbers


@lru_cache(maxsize=2)
def heard(observed: Observed) -> tuple[Heard, ...]:
    """Return the classification of each process life of a campaign."""
    n_joints = len(observed.cell.joint_names)
    return tuple(_Classifier(life, n_joints).done() for life in observed.runs)


@dataclass
class _Part:
    init: bytes
    at: int
    index: list[int] = field(default_factory=list)
    silent: list[bool] = field(default_factory=list)


class _Classifier:
    """Classifies a life packet by packet with `Reception`."""

    def __init__(self, life: Life, n_joints: int) -> None:
        self._life = life
        self._n_joints = n_joints
        self._arm = int(life.settings.get("arm", 1))
        self._silence = float(life.settings.get("silence_timeout", SILENCE_TIMEOUT))
        self._reception = Reception(self._silence)
        self._deadline = np.inf
        self._reply = b""
        self._parts: list[_Part] = []
        self._kinds: list[Kind] = []
        self._wrong: list[tuple[int, str]] = []
        self._left_out: list[int] = []
        self._missed = self._repeated = 0
        self._slots: tuple[int, ...] = ()
        self._ticks = [act.before for act in life.acts if act.name == "tick"]

    def done(self) -> Heard:
        for index, exchanged in enumerate(self._life.exchanged):
            self._classify(index, exchanged)
        events = _by_session(self._life)
        talks = tuple(
            self._talk(part, events[number] if number < len(events) else ())
            for number, part in enumerate(self._parts)
        )
        return Heard(
            talks,
            tuple(self._kinds),
            tuple(self._wrong),
            tuple(self._left_out),
            Counter(self._kinds),
            self._repeated,
            self._missed,
        )

    def _classify(self, index: int, exchanged: Exchanged) -> None:
        reception = self._reception
        if self._fell_silent(index, exchanged.now) and not reception.ended:
            reception.silent = reception.n_axes is not None
        if not exchanged.given:
            recent = self._life.exchanged[max(0, index - _RECENT) : index]
            self._repeated += any(exchanged.packet == other.packet for other in recent)
            self._kinds.append("nothing")
            self._left_out.append(index)
            return
        if exchanged.now >= self._deadline and not reception.ended:
            self._wrong.append((index, "came after a silence that was not detected"))
        last = reception.last
        silent = reception.silent
        kind = reception.expect(exchanged.packet)
        self._kinds.append(kind if exchanged.replies else "nothing")
        if not exchanged.replies:
            # The last packet of a life may have no answer.
            if kind != "nothing" and index < len(self._life.exchanged) - 1:
                self._wrong.append((index, f"got no answer although required ({kind})"))
            return
        if len(exchanged.replies) > 1:
            self._wrong.append((index, f"{len(exchanged.replies)} answers"))
        self._judge(index, exchanged, kind)
        if kind in ("echo", "init", "cyclic"):
            self._reply = exchanged.replies[0]
        if kind == "init":
            self._begin(index, exchanged)
        if kind == "cyclic" and self._parts:
            ahead = (number_of(exchanged.packet) - last) % LAST
            if 1 <= ahead <= reception.window:
                self._missed += ahead - 1
            self._parts[-1].index.append(index)
            self._parts[-1].silent.append(silent)
        if kind in ("echo", "init", "cyclic"):
            self._deadline = exchanged.now + self._patience(exchanged.packet, kind)

    def _fell_silent(self, index: int, now: float) -> bool:
        """Whether the session detected a silence before this packet or with it."""
        fell = False
        while self._ticks and self._ticks[0] <= index + (now >= self._deadline):
            self._ticks.pop(0)
            self._deadline = np.inf
            fell = True
        return fell

    def _judge(self, index: int, exchanged: Exchanged, kind: Kind) -> None:
        """Check an answer as far as it depends on the packet and the previous answer."""
        reply = exchanged.replies[0]
        if kind == "nothing":
            self._wrong.append((index, "was answered although it must not be"))
        elif kind == "again" and reply != self._reply:
            self._wrong.append((index, "came twice, and the second answer differs"))
        elif kind in ("echo", "init") and reply != oracle.echo(exchanged.packet):
            self._wrong.append((index, "was not echoed byte for byte with its number plus one"))
        elif kind == "cyclic":
            n_axes = self._reception.n_axes
            assert n_axes is not None
            if len(reply) != oracle.length(n_axes):
                self._wrong.append((index, f"was answered by {len(reply)} bytes"))
            if _END in exchanged.packet and {*_modes(exchanged.packet, range(n_axes))} == {504}:
                self._reception.ended = True
        if kind != "cyclic" and exchanged.record >= 0:
            self._wrong.append((index, f"has a record though it is not a cyclic packet ({kind})"))
        if kind == "cyclic" and exchanged.record < 0:
            self._wrong.append((index, "is a new cyclic packet and has no record"))

    def _begin(self, index: int, exchanged: Exchanged) -> None:
        init = Init.of(exchanged.packet, self._arm, self._n_joints)
        self._parts.append(_Part(exchanged.packet, index))
        self._slots = init.slots or ()

    def _patience(self, packet: bytes, kind: Kind) -> float:
        """Return the timeout of silence after this packet [s]."""
        if self._reception.ended:
            return np.inf
        if self._reception.n_axes is None:
            return INIT_TIMEOUT
        on = kind == "cyclic" and packet[3 + self._arm] == oracle.DRIVE_ON
        if on and (_PAUSED[0] in packet or _PAUSED[1] in packet):
            modes = {*_modes(packet, self._slots)}
            if modes & {*PAUSES} and modes <= _KNOWN:
                return INIT_TIMEOUT
        return self._silence

    def _talk(self, part: _Part, events: tuple[Event, ...]) -> Talk:
        life = self._life
        init = Init.of(part.init, self._arm, self._n_joints)
        first = events[0] if events else None
        usable = isinstance(first, InitReceived) and first.unusable is None
        rows = [life.exchanged[i] for i in part.index]
        # Answers that are too short were reported above and cannot be decoded.
        fit = [
            k
            for k, exchanged in enumerate(rows)
            if len(exchanged.replies[0]) >= oracle.length(init.n_axes)
        ]
        received = Packets.of([rows[k].packet for k in fit], init.n_axes)
        answer = Packets.of([rows[k].replies[0] for k in fit], init.n_axes)
        index = np.array([part.index[k] for k in fit], np.intp)
        silent = np.array([part.silent[k] for k in fit], np.bool_)
        return Talk(life, init, usable, events, part.at, index, silent, received, answer)


def _by_session(life: Life) -> list[tuple[Event, ...]]:
    """Return the events of each session, by their order, from its init packet on."""
    events = [event for _, event in life.events]
    begins = [at for at, event in enumerate(events) if isinstance(event, InitReceived)]
    return [tuple(events[a:b]) for a, b in pairwise([*begins, len(events)])]


def _modes(packet: bytes, slots: Iterable[int]) -> Iterator[int]:
    for slot in slots:
        yield int.from_bytes(packet[12 + 36 * slot : 16 + 36 * slot], "little", signed=True)
