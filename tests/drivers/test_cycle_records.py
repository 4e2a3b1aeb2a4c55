"""Records of cycles and raw packets, their rings, and events and errors in other processes."""

from __future__ import annotations

import dataclasses
import os
import pickle
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import errors, events
from drivers.c4g_packets import InitPacket
from drivers.cycle_records import (
    MEASURED,
    CycleRing,
    RingReader,
    cycle_dtype,
)
from drivers.errors import (
    AxisNotInMode,
    Check,
    DriverError,
    DriveTrainError,
    ExitTimeout,
    GuardError,
    ModeRefused,
    PacketError,
    RefusalError,
    RequestError,
    SourceFailed,
    TransportClosed,
)
from tests.drivers.rig import Cruise, N, moving

pytestmark = pytest.mark.safety


def write(ring: CycleRing, numbers) -> None:
    for number in numbers:
        row = ring.slot
        ring.number[row] = number
        ring.commit()


class TestRing:
    def test_later_reader_begins_with_the_oldest_available(self):
        ring = CycleRing.shared(N, 10)
        write(ring, range(25))
        reader = RingReader(ring.fd, N)
        assert reader.drain()["number"].tolist() == list(range(16, 25))
        assert reader.missed == 0

    def test_writer_counts_records_overwritten_unread(self):
        ring = CycleRing.shared(N, 10)
        reader = RingReader(ring.fd, N)
        spectator = RingReader(ring.fd, N, acknowledge=False)
        write(ring, range(10))
        assert ring.overflow == 0
        assert len(spectator.drain()) == 9
        write(ring, range(10, 13))
        assert ring.overflow == 3
        reader.drain()
        write(ring, range(13, 23))
        assert ring.overflow == 3
        write(ring, range(23, 24))
        assert ring.overflow == 4

    @given(st.lists(st.integers(0, 25), max_size=30))
    def test_each_record_is_read_in_order_or_counted(self, steps):
        ring = CycleRing.shared(1, 10)
        reader = RingReader(ring.fd, 1)
        seen = []
        written = 0
        for count in steps:
            write(ring, range(written, written + count))
            written += count
            seen += reader.drain()["number"].tolist()
        assert seen == sorted(set(seen))
        assert len(seen) + reader.missed == written
        os.close(ring.fd)

    def test_records_overwritten_during_the_copy_are_dropped(self):
        ring = CycleRing.shared(N, 10)
        reader = RingReader(ring.fd, N)
        write(ring, range(9))
        rows = reader.rows

        class Overtaken:
            def take(self, index, mode):
                write(ring, range(9, 13))
                return rows.take(index, mode=mode)

        reader.rows = Overtaken()
        assert reader.drain()["number"].tolist() == [4, 5, 6, 7, 8]
        assert reader.missed == 4

    def test_shared_memory_states_what_its_records_have(self):
        state = np.dtype([("temperature", "f8", (2,)), ("mode", "i4")])
        ring = CycleRing(2, fd=CycleRing.shared(2, 10, state).fd)
        reader = RingReader(ring.fd, 2)
        ring.arm_state[ring.slot] = ([20.5, 21.0], 7)
        write(ring, [3])
        (row,) = reader.drain()
        assert row["number"] == 3
        assert row["arm_state"]["temperature"].tolist() == [20.5, 21.0]
        assert row["arm_state"]["mode"] == 7
        assert CycleRing.shared(2, 10).arm_state is None
        assert "arm_state" not in cycle_dtype(2).names

    def test_other_memory_is_refused(self):
        ring = CycleRing.shared(N, 10)
        with pytest.raises(ValueError, match="for 6 joints, not 7"):
            RingReader(ring.fd, 7)
        with pytest.raises(ValueError, match="at least 2"):
            CycleRing.shared(N, 1)


def test_blocks_and_fields_are_the_same_memory():
    ring = CycleRing(3, 4)
    ring.measured[2] = np.arange(24).reshape(8, 3)
    ring.commanded[2] = [[-1, -2, -3], [-4, -5, -6]]
    row = ring.rows[2]
    for index, name in enumerate(MEASURED):
        np.testing.assert_array_equal(row[name], [3 * index, 3 * index + 1, 3 * index + 2])
    np.testing.assert_array_equal(row["commanded_position"], [-1, -2, -3])
    np.testing.assert_array_equal(row["commanded_velocity"], [-4, -5, -6])
    assert not ring.rows[1]["position"].any()


def test_ring_of_its_own_memory():
    ring = CycleRing(2, 8)
    write(ring, range(5))
    assert ring.drain()["number"].tolist() == [0, 1, 2, 3, 4]
    write(ring, range(5, 7))
    assert ring.last(4)["number"].tolist() == [3, 4, 5, 6]
    assert ring.last(50)["number"].tolist() == [0, 1, 2, 3, 4, 5, 6]
    write(ring, range(7, 16))
    assert ring.overflow == 3
    assert ring.drain()["number"].tolist() == list(range(8, 16))


EXAMPLES = {
    DriverError: DriverError("anything"),
    PacketError: PacketError("open_axes_map", [1, 1], "each slot once"),
    DriveTrainError: DriveTrainError("gear_ratio", [0.0], "no zero"),
    RequestError: RequestError("open", "no", "change of override"),
    TransportClosed: TransportClosed("gone"),
    RefusalError: RefusalError("why", 17),
    SourceFailed: SourceFailed("row 3", 4),
    AxisNotInMode: AxisNotInMode("joint 3 is in mode 0", 99),
    ModeRefused: ModeRefused("joint 3 is in mode 3", 99),
    ExitTimeout: ExitTimeout("open", 6000),
    GuardError: GuardError(Check.JERK, 1, 2.0, 0.0, 3),
    errors.SessionFailed: errors.SessionFailed("why", 7),
}


def subclasses(kind):
    return {kind}.union(*(subclasses(child) for child in kind.__subclasses__()))


KINDS = sorted(
    {
        kind
        for kind in subclasses(DriverError)
        if kind in vars(errors).values() and "_" not in kind.__name__
    },
    key=lambda kind: kind.__name__,
)


def through_pickle(thing):
    for protocol in (2, pickle.HIGHEST_PROTOCOL):
        thing = pickle.loads(pickle.dumps(thing, protocol))
    return thing


def assert_same(mine, theirs):
    assert type(mine) is type(theirs)
    if isinstance(mine, np.ndarray):
        assert mine.dtype == theirs.dtype
        assert mine.tobytes() == theirs.tobytes()
    elif isinstance(mine, BaseException):
        assert str(mine) == str(theirs)
        assert mine.args == theirs.args
        assert mine.__dict__ == theirs.__dict__
    elif isinstance(mine, InitPacket):
        assert mine.encode() == theirs.encode()
    elif dataclasses.is_dataclass(mine):
        for field in dataclasses.fields(mine):
            assert_same(getattr(mine, field.name), getattr(theirs, field.name))
    else:
        assert mine == theirs


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_errors_pickle(kind):
    error = EXAMPLES[kind]
    assert_same(error, through_pickle(error))


@pytest.mark.parametrize("check", Check)
def test_guard_error_states_check_joint_value_bound_and_cycle(check):
    error = GuardError(check, 3, -1.25, 0.5, 1234)
    assert (error.joint, error.value, error.bound, error.cycle) == (3, -1.25, 0.5, 1234)
    assert (error.check, error.unit, error.remedy) == (check, check.unit, check.remedy)
    for part in (check.quantity, "joint 4", "-1.25", "0.5", "cycle 1234"):
        assert part in str(error)
    assert through_pickle(error).check is check


def test_events_of_a_session_pickle():
    rig, _ = moving()
    rig.session.stop()
    rig.run()
    requests = dict.fromkeys(("hold", "resume", "override"), lambda *_: None)
    steered = type("Steered", (Cruise,), requests)
    rig.session.request(steered())
    rig.session.override(0.5)
    rig.session.hold()
    rig.open()
    rig.cycle(300)
    rig.send(b"rubbish")
    rig.miss(1)
    before = rig.axes["d"].copy()
    rig.cycle()
    rig.axes["d"][:] = before  # the answer was lost
    rig.cycle()
    rig.axes["d"][0, 4] = 99.0
    rig.cycle()
    rig.session.tick(rig.now + 5.0)
    rig.events += rig.session.events()
    rig.events.append(events.ControllerRemark("a C4G has none", rig.session.cycle))
    assert {type(event) for event in rig.events} == set(get_args(events.Event))
    for event in rig.events:
        assert_same(event, through_pickle(event))
