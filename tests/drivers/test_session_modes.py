"""Open modes, field by field; holds and overrides of a motion in any of them."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import HoldChanged, OverrideChanged, RequestError, SourceFailed, State
from drivers.c4g_packets import MODE_FIELDS
from drivers.errors import (
    Check,
)
from drivers.states import HOLDABLE_MODES, INCREMENTAL_MODES, POSITION_MODES
from planner import JointLimits, TrajectoryPlayer, plan
from tests import messages
from tests.drivers.rig import (
    MOVE,
    PERIOD,
    START,
    Cruise,
    N,
    Rig,
    Unspeakable,
    Unstopped,
    accelerating,
    all_drive_off,
    assert_refused,
    closed,
    kind_of,
    limits,
    moving,
    opened,
    running,
)
from tests.messages import MOTION_BEING_STOPPED

pytestmark = pytest.mark.safety


def only_fields_of(mode: int, answer) -> bool:
    others = [d - 1 for d in range(1, 6) if d not in MODE_FIELDS[mode]]
    return not answer.axes["d"][:, others].any() and not answer.axes["extra"].any()


def test_fields_of_the_documented_modes():
    assert {int(mode): fields for mode, fields in MODE_FIELDS.items() if mode < 10} == {
        1: (1, 2, 4, 5), 2: (4, 5), 4: (1, 2), 5: (1, 2), 7: (1,), 8: (4,), 9: (5,),
    }  # fmt: skip
    for mode, fields in MODE_FIELDS.items():
        assert mode < 10 or MODE_FIELDS[mode - 10] == fields
    assert {1, 4, 5, 11, 14, 15} == HOLDABLE_MODES
    assert {2, 7, 8, 9, 12, 17} == INCREMENTAL_MODES
    assert {4, 5} == POSITION_MODES


class TestEveryMode:
    @pytest.mark.parametrize("mode", sorted(POSITION_MODES))
    def test_arm_is_held_without_a_motion(self, mode):
        rig = Rig(mode=mode)
        for answer in (rig.open(), rig.cycle(20)):
            assert (answer.axes["mode"] == mode).all()
            assert only_fields_of(mode, answer)
            assert answer.status == bytes(4)
        motor = rig.train.motor_revolutions(START).astype(np.float32)
        np.testing.assert_array_equal(answer.axes["d"][:, 0], motor)

    @pytest.mark.parametrize("source", [None, object(), 3, "begin"])
    def test_what_is_no_source_is_refused(self, source):
        message = f"a {type(source).__name__} is not a motion source"
        with pytest.raises(RequestError, match=message):
            Rig().session.request(source)

    @pytest.mark.parametrize("mode", sorted(POSITION_MODES))
    @pytest.mark.parametrize(
        ("begun", "column", "off", "kind"),
        [
            (True, 2, 2.01, Check.FOLLOWING_ERROR),
            (False, 2, 0.21, Check.FIRST_SET_POINT),
            (False, 1, 6e-4, Check.STANDSTILL),
            (False, 4, 20.1, Check.CURRENT),
        ],
    )
    def test_arm_begins_and_rests_at_its_target(self, mode, begun, column, off, kind):
        rig = (opened if begun else closed)(mode=mode)
        rig.axes["d"][3, column] += off
        answer = rig.cycle(mode=mode)
        assert (kind_of(rig.refusal), rig.refusal.joint) == (kind, 3)
        reported = [mode] * 3 + [508] + [mode] * 2 if begun else [505] * N
        assert answer.axes["mode"].tolist() == reported

    @pytest.mark.parametrize("mode", sorted(POSITION_MODES))
    def test_axis_that_opens_is_at_its_target(self, mode):
        rig = closed(mode=mode)
        rig.modes[3] = mode
        rig.axes["d"][3, 2] += 2.01
        assert rig.cycle().axes["mode"].tolist() == [0, 0, 0, 508, 0, 0]
        assert (kind_of(rig.refusal), rig.refusal.joint) == (Check.FOLLOWING_ERROR, 3)

    @pytest.mark.parametrize("mode", [1, 2, 3, 6, 7, 8, 9, 11, 12, 14, 15, 17])
    def test_modes_not_served_are_not_moved(self, mode):
        rig = Rig()
        rig.session.request(Cruise())
        rig.close()
        answer = rig.cycle(mode=mode)
        if mode in (3, 6):
            assert not answer.axes["mode"].any()
            assert not answer.axes["d"].any()
        else:
            assert all_drive_off(answer)
        assert rig.state is State.FAULTED
        assert rig.ended.outcome in ("lost", "refused")


def player() -> TrajectoryPlayer:
    rates = ("lower", "upper", "velocity", "acceleration", "jerk")
    bounds = JointLimits(**{name: getattr(limits(), name) for name in rates})
    return TrajectoryPlayer(plan([START, START + MOVE], bounds, fly=0.0), PERIOD, bounds)


def playing() -> Rig:
    rig = running(player(), 60)
    assert rig.state is State.OPEN
    return rig


def do_nothing(self):
    pass


def failing(*parts: str, error: BaseException, **others) -> Cruise:
    """A source that can hold and resume, but fails in these parts."""

    def fails(self, *_):
        raise error

    methods = {"hold": do_nothing, "resume": do_nothing} | dict.fromkeys(parts, fails) | others
    return type("Failing", (Cruise,), methods)()


def at_rest(rig: Rig) -> bool:
    return not rig.records[-1]["commanded_velocity"].any()


class TestHold:
    def test_hold_without_limit_and_resume(self):
        rig = playing()
        assert not at_rest(rig)
        rig.session.hold()
        rig.cycle(300)
        assert at_rest(rig)
        # Longer than a stop may take, which is 10 s.
        rig.cycle(6000)
        assert (rig.state, rig.exits_asked) == (State.OPEN, 0)
        assert at_rest(rig)
        rig.session.resume()
        rig.cycle(20)
        assert not at_rest(rig)
        rig.run_to("completed")
        end = rig.train.joint_position(rig.axes["d"][:, 0])
        np.testing.assert_allclose(end, START + MOVE, atol=1e-6)

    @pytest.mark.parametrize("cycles", [3, 300])
    def test_a_stop_ends_a_hold(self, cycles):
        rig = playing()
        rig.session.hold()
        rig.cycle(cycles)
        rig.session.stop()
        rig.run_to("stopped")

    def test_source_without_hold_is_stopped(self):
        rig, source = moving()
        rig.session.hold()
        rig.run()
        assert source.stops == 1
        assert rig.ended.outcome == "stopped"
        assert rig.ended.reason == messages.CANNOT_HOLD
        rig = closed()  # one that has not begun is dropped
        rig.session.request(Cruise())
        rig.session.hold()
        rig.cycle()
        assert (rig.ended.outcome, rig.ended.interval) == ("stopped", -1)

    def test_one_event_per_change(self):
        rig = playing()
        for _ in range(2):
            rig.session.override(0.5)
            rig.session.hold()
            rig.cycle(10)
        for _ in range(2):
            rig.session.resume()
        cycle = rig.session.cycle
        rig.run()
        assert rig.seen(OverrideChanged) == [OverrideChanged(0.5, cycle - 20)]
        assert rig.seen(HoldChanged) == [HoldChanged(True, cycle - 20), HoldChanged(False, cycle)]


def no(self):
    raise SystemExit("no")


class TestSourcesThatRaise:
    """A method, or a property where a method should be."""

    @pytest.mark.parametrize(
        ("source", "message"),
        [
            (failing(error=SystemExit(), override=property(no)), "SystemExit: no"),
            (failing(error=SystemExit(), resume=property(no)), "SystemExit: no"),
            (failing("override", error=Unspeakable()), "Unspeakable without a message"),
            (failing("override", error=ZeroDivisionError("not now")), "ZeroDivisionError: not now"),
        ],
    )
    def test_request_is_refused_and_the_motion_continues(self, source, message):
        rig = running(source, 50)
        with pytest.raises(RequestError, match=message):
            if isinstance(vars(type(source))["resume"], property):
                rig.session.resume()
            else:
                rig.session.override(0.5)
        rig.cycle(5)
        assert rig.state is State.OPEN

    @pytest.mark.parametrize("name", ["begin", "stop"])
    def test_property_that_raises(self, name):
        rig = Rig()
        source = failing(error=SystemExit(), **{name: property(no)})
        rig.session.request(source)
        rig.open()
        if name != "begin":
            rig.cycle(300)
            assert rig.state is State.OPEN
            rig.session.stop()
            rig.cycle()
        what = "cannot begin" if name == "begin" else "failed to stop"
        assert f"the motion source {what}: SystemExit: no" in str(rig.refusal)
        assert type(rig.refusal) is SourceFailed

    def test_source_that_fails_to_hold(self):
        """It is stopped, or refused at its begin."""
        rig = running(source := failing(error=SystemExit(), hold=property(no)), 50)
        rig.session.hold()
        rig.cycle()
        assert source.stops == 1
        rig = Rig()
        rig.session.request(failing("hold", error=ValueError("no")))
        rig.session.hold()
        answer = rig.open()
        assert "failed to hold: ValueError: no" in str(assert_refused(rig, answer, SourceFailed))


@pytest.mark.parametrize("where", ["guard", "record of the packet"])
def test_internal_error_requests_drive_off(where, monkeypatch):
    rig, _ = moving()

    def fails(*_, **__):
        raise MemoryError("no room")

    owner = rig.guard
    name = "check_set_point"
    if where != "guard":
        owner = rig.session
        name = "_record"
    monkeypatch.setattr(owner, name, fails)
    assert all_drive_off(rig.cycle())
    assert "the session failed: MemoryError: no room" in str(rig.refusal)
    assert rig.ended.outcome == "refused"
    assert all_drive_off(rig.cycle())


WIDE = {"jerk": np.full(N, 1e9)}


class Overridable(Unstopped):
    """Has the bounds of an override from the first on."""

    def __init__(self, positions):
        super().__init__(positions)
        self.fractions = []

    def override(self, fraction):
        self.fractions.append(fraction)
        self.bounds = "override"


def test_override_and_its_bounds():
    rig = Rig()  # requested before the motion begins
    rig.session.request(source := Overridable(np.tile(START, (20, 1))))
    rig.session.override(0.25)
    rig.open()
    rig.run_to("completed")
    assert source.fractions == [0.25]
    for scale, refused in ((0.999, False), (1.001, True)):
        rig = running(Overridable(accelerating(8.0 * 1.3 * scale)), guard_limits=limits(**WIDE))
        rig.session.override(0.5)
        answer = rig.cycle(2)
        if refused:
            assert_refused(rig, answer, Check.ACCELERATION)
        else:
            rig.cycle(30)
            assert rig.state is State.OPEN


STOPPING = MOTION_BEING_STOPPED
WHAT = {"override": "change of override", "hold": "hold", "resume": "resumption"}
NOT_FITTING = [
    (lambda: Rig(), "override", "no motion was requested"),
    (lambda: moving(10)[0], "override", "this motion has no override"),
    (lambda: stopping(Overridable(np.tile(START, (20, 1)))), "override", STOPPING),
    (lambda: opened(), "hold", "no motion was requested"),
    (lambda: Rig(), "resume", "no motion was requested"),
    (lambda: moving(10)[0], "resume", "this motion cannot be held"),
    (lambda: stopping(player()), "resume", STOPPING),
]


def stopping(source) -> Rig:
    rig = running(source, 5)
    if hasattr(source, "hold"):
        rig.session.hold()
    rig.session.stop()
    rig.cycle()
    return rig


@pytest.mark.parametrize(("situation", "request_", "reason"), NOT_FITTING)
def test_refused_overrides_and_resumptions(situation, request_, reason):
    rig = situation()
    state = rig.state
    message = f"no {WHAT[request_]} can be requested in state '{state.name.lower()}': {reason}"
    with pytest.raises(RequestError, match=f"^{message}$"):
        getattr(rig.session, request_)(*[0.5] * (request_ == "override"))
    assert rig.state is state
