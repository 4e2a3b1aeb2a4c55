"""A session under arbitrary packets and motions, judged from outside at every step.

The controller here obeys or not, opens its axes properly or not, loses packets, repeats them,
garbles them, starts anew; the motions are good, at the edge of the bounds, or broken. What must
hold whatever happens is in `judge`.
"""

from __future__ import annotations

import struct

import numpy as np
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    precondition,
    rule,
)

from drivers import (
    CycleRing,
    Guard,
    RequestError,
    Session,
    State,
)
from tests.drivers import oracle
from tests.drivers.judge import POSITION_MODES, Conduct
from tests.drivers.judged import Judged
from tests.drivers.model_controller import (
    ARMS,
    AXES,
    GOOD_INIT,
    OTHER_ARM,
    OTHER_AXES,
    PERIOD,
    SLOTS,
    Controller,
    N,
)
from tests.drivers.reception import number_of
from tests.drivers.rig import START, drive_train, limits
from tests.drivers.sources import WILD, corrections, motions

SILENCE = 1.0
"""s that a session bears while no axis is open."""
MAX_GAP = 2

open_modes = st.sampled_from([1, 2, 4, 5, 7, 8, 9])
any_mode = st.sampled_from(
    [0, 0, 10, 501, 4, 4, 5, 1, 2, 7, 8, 9, 3, 6, 11, 12, 14, 17, 500, 502, 504, 505, 506, 508, -1]
) | st.integers(-(2**31), 2**31 - 1)
wild = st.sampled_from(WILD) | st.floats(allow_nan=True, width=32)


class SessionMachine(Judged, RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.mode = 4
        self.seen_states: set[State] = set()

    @initialize(
        mode=open_modes, obedient=st.booleans(), cold=st.booleans(), settle=st.integers(0, 3)
    )
    def begin(self, mode, obedient, cold, settle):
        self.mode, self.obedient = mode, obedient
        ring = CycleRing(N, 512)
        self.limits, self.train = limits(), drive_train()
        session = Session(
            self.train,
            Guard(self.limits, PERIOD),
            ring,
            mode=mode,
            max_gap=MAX_GAP,
            other_axes=OTHER_AXES,
            settle_cycles=settle,
        )
        self.controller = Controller()
        self.hear(
            session, ring, self.new_conduct(), n_axes=len(AXES), max_gap=MAX_GAP, silence=SILENCE,
            period=PERIOD, inits={GOOD_INIT: True, OTHER_ARM: False},
        )  # fmt: skip
        if cold:
            for number in range(1, 10):
                self.send(number.to_bytes(4, "little") + bytes(728))
        self.start()
        self.run(1)

    def new_conduct(self) -> Conduct:
        return Conduct(
            self.limits,
            self.train,
            self.mode,
            1,
            SLOTS,
            ARMS,
            threshold=np.full(N, 2.0),
            current=np.full(N, 20.0),
            max_gap=MAX_GAP,
        )

    def start(self, init: bytes = GOOD_INIT) -> None:
        self.send(init)
        self.controller.number = 10

    def send(self, packet: bytes, elapsed: float = PERIOD) -> bytes | None:
        """Deliver it, and have the outcome judged."""
        reply = self.deliver(packet, elapsed)
        self.seen_states.add(self.session.state)
        return reply

    def run(self, cycles: int) -> None:
        for _ in range(cycles):
            reply = self.send(self.controller.packet())
            if reply is not None and self.obedient and self.reception.n_axes is not None:
                self.controller.obey(reply, self.mode)

    # What the controller does -------------------------------------------------------------

    @rule(cycles=st.integers(1, 40))
    def go_on(self, cycles):
        self.run(cycles)

    @rule(source_seed=st.integers(0, 2), cycles=st.integers(1, 60), stagger=st.booleans())
    def open_properly(self, source_seed, cycles, stagger):
        """Drive on, closed, then all axes open, at once or one by one."""
        self.controller.status[0] = oracle.DRIVE_ON
        self.controller.put_arm_at(START)
        self.controller.wanted(0)
        self.run(1 + source_seed)
        for slot in SLOTS:
            self.controller.modes[slot] = self.mode
            if stagger:
                self.run(1)
        self.run(cycles)

    @rule(mode=any_mode)
    def all_modes(self, mode):
        self.controller.modes = [mode] * len(AXES)
        self.run(1)

    @rule(slot=st.integers(0, len(AXES) - 1), mode=any_mode)
    def one_mode(self, slot, mode):
        self.controller.modes[slot] = mode
        self.run(1)

    @rule(joint=st.integers(0, N - 1))
    def one_axis_closes(self, joint):
        self.controller.modes[SLOTS[joint]] = 0
        self.run(2)

    @rule(arm=st.integers(0, 3), status=st.sampled_from([5, 5, 0, 1, 4, 255]))
    def drive(self, arm, status):
        self.controller.status[arm] = status
        self.run(1)

    @rule(
        slot=st.integers(0, len(AXES) - 1),
        column=st.integers(0, 7),
        value=wild,
        cycles=st.integers(1, 2),
    )
    def disturb(self, slot, column, value, cycles):
        kept = self.controller.d[slot, column]
        for _ in range(cycles):
            with np.errstate(all="ignore"):
                self.controller.d[slot, column] = value
            self.run(1)
        self.controller.d[slot, column] = kept

    @rule(
        joint=st.integers(0, N - 1),
        column=st.sampled_from([1, 2, 3]),
        value=st.sampled_from([4e-4, 1e-3, 0.19, 0.21, 1.9]),
    )
    def open_with_the_arm_elsewhere_or_moving(self, joint, column, value):
        self.controller.put_arm_at(START)
        self.controller.d[SLOTS[joint], column] += value
        self.controller.status[0] = oracle.DRIVE_ON
        for mode in (0, self.mode):
            self.controller.wanted(mode)
            self.send(self.controller.packet())
        self.controller.put_arm_at(START)

    @rule(
        joint=st.integers(0, N - 1),
        column=st.sampled_from([2, 4]),
        value=st.sampled_from([1.9, 2.1, 19.0, 21.0, -30.0]),
    )
    @precondition(lambda self: self.session.state is State.OPEN)
    def the_arm_does_not_follow(self, joint, column, value):
        self.controller.d[SLOTS[joint], column] += value
        self.send(self.controller.packet())
        self.controller.d[SLOTS[joint], column] -= value

    @rule(count=st.integers(1, 6))
    def miss(self, count):
        for _ in range(count):
            self.controller.packet()
        self.now += count * PERIOD
        self.run(1)

    @rule(ages=st.none() | st.lists(st.integers(0, 3), min_size=8, max_size=8))
    def values_grow_old(self, ages):
        self.ages = None if ages is None else np.tile(np.uint16(ages), (len(AXES), 1))
        self.run(1)
        self.ages = None

    # What the line does -------------------------------------------------------------------

    @rule(copies=st.integers(1, 3))
    def duplicate(self, copies):
        if self.last is not None:
            for _ in range(copies):
                self.send(self.last[0])

    @rule(behind=st.integers(1, 40000))
    def out_of_turn(self, behind):
        packet = bytearray(self.controller.packet())
        self.controller.number = (self.controller.number - 2) % 0x7FFF + 1
        number = (number_of(packet) - behind - 1) % 0x7FFF + 1
        packet[:4] = number.to_bytes(4, "little")
        reply = self.send(bytes(packet))
        if reply is not None:
            self.controller.number = self.reception.last

    @rule(size=st.integers(0, 1300), fill=st.binary(min_size=1, max_size=8))
    def cut_or_lengthen(self, size, fill):
        packet = self.controller.packet()
        self.send((packet + fill * 200)[:size])
        self.controller.number = self.reception.last

    @rule(position=st.integers(4, 299), flip=st.integers(1, 255))
    def corrupt(self, position, flip):
        packet = bytearray(self.controller.packet())
        packet[position] ^= flip
        self.send(bytes(packet))

    @rule(
        packet=st.binary(max_size=80), number=st.integers(-(2**31), 2**31 - 1) | st.integers(0, 30)
    )
    def noise(self, packet, number):
        self.send(struct.pack("<i", number) + packet)
        self.controller.number = self.reception.last

    @rule(ticks=st.integers(0, 2))
    def silence(self, ticks):
        for _ in range(ticks):
            self.now += 400.0
            self.session.tick(self.now)
            self.silence_heard()
            self.take_events()
        self.send(self.controller.packet(), elapsed=400.0)

    @rule(other=st.sampled_from([False, False, True]))
    def start_over(self, other):
        self.start(OTHER_ARM if other else GOOD_INIT)
        self.run(1)

    @rule(number=st.integers(1, 13))
    def sync(self, number):
        status = bytes([0, 0, 0, 0])
        self.send(number.to_bytes(4, "little") + status + bytes(724))
        self.controller.number = self.reception.last

    # What the user does -------------------------------------------------------------------

    @rule(data=st.data())
    def request(self, data):
        if data.draw(st.integers(0, 9)):
            fits = self.mode in POSITION_MODES
        else:
            fits = self.mode not in POSITION_MODES  # the wrong kind of source
        source = data.draw(motions(N) if fits else corrections(N, self.mode))
        try:
            self.session.request(source)
        except RequestError:
            return
        assert fits == (self.mode in POSITION_MODES), "the wrong kind of source was taken"
        assert self.conduct.usable or self.session.init is None
        self.conduct.entitled = True
        self.conduct.stopping = self.conduct.overridden = False

    @rule(data=st.data(), cycles=st.integers(20, 150))
    @precondition(lambda self: not self.session.requested)
    def request_and_open(self, data, cycles):
        self.request(data)
        self.open_properly(0, cycles, stagger=False)

    @rule(data=st.data(), cycles=st.integers(1, 100))
    @precondition(lambda self: self.session.state is State.OPEN and not self.session.requested)
    def request_in_open_mode(self, data, cycles):
        self.request(data)
        self.run(cycles)

    @rule(cycles=st.integers(1, 200))
    @precondition(lambda self: self.session.requested and self.session.state is State.OPEN)
    def move_on(self, cycles):
        self.run(cycles)

    @rule()
    def stop(self):
        self.session.stop()
        self.take_events()
        self.conduct.stopping = self.conduct.entitled
        self.run(1)

    @rule(fraction=st.floats(0.0, 1.0) | wild)
    def override(self, fraction):
        try:
            self.session.override(fraction)
        except RequestError:
            return
        assert 0.0 <= fraction <= 1.0
        self.conduct.overridden = True

    @precondition(lambda self: self.reception.ended)
    @rule(mode=open_modes, obedient=st.booleans(), settle=st.integers(0, 3))
    def new_session(self, mode, obedient, settle):
        self.begin(mode, obedient, False, settle)
