"""Events and errors are told to other processes: nothing is lost on the way."""

from __future__ import annotations

import dataclasses
import pickle
from typing import get_args

import numpy as np
import pytest

from drivers import errors, events
from drivers.errors import (
    AxisLeft,
    CorrectionNotEnded,
    DriverError,
    DriveTrainError,
    ExitNotGranted,
    GuardError,
    ModeRefused,
    PacketError,
    RefusalError,
    RequestError,
    SourceFailed,
    TransportClosed,
)
from drivers.packets import InitPacket
from drivers.record import cycle_dtype
from drivers.states import State
from tests.drivers.rig import Cruise, Rig, init_packet, moving, running, still

EXAMPLES = {
    DriverError: DriverError("anything"),
    PacketError: PacketError("open_axes_map", [1, 1], "each slot once"),
    DriveTrainError: DriveTrainError("gear_ratio", [0.0], "no zero"),
    RequestError: RequestError("open", "no", "change of override"),
    TransportClosed: TransportClosed("gone"),
    RefusalError: RefusalError("why", 17),
    SourceFailed: SourceFailed("row 3", 4),
    AxisLeft: AxisLeft(2, 0, 4, 99),
    ModeRefused: ModeRefused(2, 3, False, 99),
    ExitNotGranted: ExitNotGranted(5000, 6000),
    errors.SessionFailed: errors.SessionFailed(ValueError("why"), 7),
    errors.TargetNotFinite: errors.TargetNotFinite(2, 6, float("inf"), 8),
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
def test_every_error(kind):
    error = EXAMPLES.get(kind)
    if error is None:
        assert issubclass(kind, GuardError), f"no example of {kind.__name__}"
        error = kind(3, -1.25, 0.5, 1234)
        assert (error.joint, error.value, error.bound, error.cycle) == (3, -1.25, 0.5, 1234)
    again = through_pickle(error)
    assert_same(error, again)
    if isinstance(error, GuardError):
        assert again.unit == error.unit
        assert again.check == error.check


def test_an_error_with_a_unit_of_its_own():
    again = through_pickle(CorrectionNotEnded(1, 2.0, 0.0, 3, "rad/s"))
    assert again.unit == "rad/s"
    assert "2 rad/s" in str(again)


EVENTS = {
    events.InitReceived: events.InitReceived(init_packet(), "why not", ("a", "b"), True),
    events.StateChanged: events.StateChanged(State.CLOSED, State.OPEN, 5),
    events.GapSeen: events.GapSeen(2, 9),
    events.AnswersLost: events.AnswersLost(1, 9),
    events.MotionStarted: events.MotionStarted(0, 10),
    events.OverrideChanged: events.OverrideChanged(0.2, 12),
    events.HoldChanged: events.HoldChanged(True, 14),
    events.MotionEnded: events.MotionEnded("lost", "the drive went off", 0, 20),
    events.PacketRejected: events.PacketRejected("foreign", 3),
    events.Refused: events.Refused(
        errors.JerkLimit(0, 1.0, 2.0, 3), np.zeros(4, cycle_dtype(6))
    ),
    events.LinkLost: events.LinkLost(1.5, State.OPEN),
}  # fmt: skip


@pytest.mark.parametrize("kind", get_args(events.Event), ids=lambda kind: kind.__name__)
def test_every_event(kind):
    event = EVENTS[kind]
    assert type(event) is kind
    assert_same(event, through_pickle(event))


def _nothing(self, *_):
    pass


def test_events_of_a_real_session():
    rig, _ = moving()
    rig.session.stop()
    rig.run()
    steered = type("Steered", (Cruise,), dict.fromkeys(("hold", "resume", "override"), _nothing))
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
    assert {type(event) for event in rig.events} == set(get_args(events.Event))
    for event in rig.events:
        assert_same(event, through_pickle(event))


def test_the_cause_of_a_failed_source_is_in_its_message():
    class Broken:
        bounds, finished = "plan", False

        def begin(self, position):
            raise StopIteration

        advance = stop = begin

    rig = running(Broken())
    assert "StopIteration" in str(through_pickle(rig.refusal))


def test_counters_too():
    rig = Rig()
    rig.session.request(still(2))
    rig.session.discarded("torn", 4)
    rig.open()
    assert through_pickle(rig.session.counters) == rig.session.counters
