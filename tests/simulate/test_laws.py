"""A law that nothing breaks proves nothing: each finds the one thing that was altered.

One campaign with some faults is played; untouched it keeps every law. Then one thing at a time is
put out of order in what was observed, and the law whose business that is has to say so.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from drivers.events import AnswersLost, MotionEnded
from tests.drivers import oracle
from tests.simulate.altered import ALL, found, played, with_life
from tests.simulate.laws.conversation import heard, talks_of
from tests.simulate.laws.open_mode import modes_of, stretches
from tests.simulate.laws.wire import Packets, safe_answers
from tests.simulate.observed import Observed


@pytest.fixture(scope="module")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Observed:
    return played(tmp_path_factory.mktemp("simulated"))


def test_an_untouched_campaign_keeps_every_law(observed: Observed) -> None:
    assert observed.complete, observed.ended
    assert len(observed.runs) >= 2
    assert {name: found(observed, name) for name in ALL} == dict.fromkeys(ALL, "")


def test_the_faults_have_left_something_of_every_kind_to_judge(observed: Observed) -> None:
    fates = heard(observed)[0].fates
    for kind in ("init", "cyclic", "again", "nothing"):
        assert fates[kind] > 0, kind
    assert any(stretches(talk) for talk in talks_of(observed))
    assert len(list((observed.folder / "archives").glob("*.mcap"))) > 4


# Alterations of what was exchanged ----------------------------------------------------------


def with_exchanged(observed: Observed, index: int, **changes: Any) -> Observed:
    """One packet of the first life exchanged otherwise."""
    life = observed.runs[0]
    exchanged = list(life.exchanged)
    exchanged[index] = exchanged[index]._replace(**changes)
    return with_life(observed, 0, exchanged=tuple(exchanged))


def with_answer(observed: Observed, index: int, offset: int, mask: int = 1) -> Observed:
    """One byte of the answer to a packet of the first life changed."""
    reply = bytearray(observed.runs[0].exchanged[index].replies[0])
    reply[offset] ^= mask
    return with_exchanged(observed, index, replies=(bytes(reply),))


def of_kind(observed: Observed, kind: str, number: int = 0) -> int:
    """Index of the first packet of the first life that had to get such an answer."""
    kinds = heard(observed)[0].kinds
    return [index for index, one in enumerate(kinds) if one == kind][number]


def in_motion(observed: Observed) -> tuple[int, int]:
    """Index of a packet amid a motion of the first life, and byte offset of its first joint."""
    talk = heard(observed)[0].talks[0]
    stretch = max(stretches(talk), key=lambda one: one.leading)
    moving = np.flatnonzero((stretch.step[: stretch.leading] != 0.0).any(axis=1))
    return int(stretch.at[moving[len(moving) // 2]]), 12 + 36 * (talk.init.slots or (0,))[0]


def at_rest(observed: Observed) -> int:
    """Index of a packet with closed axes and the drive on."""
    talk = heard(observed)[0].talks[0]
    return int(talk.index[np.flatnonzero(modes_of(talk).closed)[2]])


def arm_of(observed: Observed) -> int:
    return int(observed.runs[0].settings["arm"])


def reply_at_rest(observed: Observed) -> bytes:
    return observed.runs[0].exchanged[at_rest(observed)].replies[0]


def first_set_point(observed: Observed) -> int:
    return int(stretches(heard(observed)[0].talks[0])[0].at[0])


ANSWERS: dict[str, tuple[Callable[[Observed], Observed], str]] = {
    "number": (lambda o: with_answer(o, at_rest(o), 0), "an answer of another number"),
    "function": (lambda o: with_answer(o, at_rest(o), 8), "function bytes"),
    "status": (lambda o: with_answer(o, at_rest(o), 4 + arm_of(o) % 4, 4), "status bytes"),
    "exit": (lambda o: with_answer(o, at_rest(o), 3 + arm_of(o)), "asked for outside of it"),
    "target when closed": (lambda o: with_answer(o, at_rest(o), 17), "not the safe answer"),
    "mode": (lambda o: with_answer(o, in_motion(o)[0], in_motion(o)[1]), "has no use for"),
    "extra": (lambda o: with_answer(o, in_motion(o)[0], in_motion(o)[1] + 24), "has no use for"),
    "init": (lambda o: with_answer(o, of_kind(o, "init"), 700), "not echoed byte for byte"),
    "duplicate": (lambda o: with_answer(o, of_kind(o, "again"), 20), "answered otherwise"),
    "none": (lambda o: with_exchanged(o, at_rest(o), replies=()), "got no answer that was due"),
    "left out": (
        lambda o: with_exchanged(o, at_rest(o), replies=(), given=False),
        "late is 0, and 1 were seen",
    ),
    "no duplicate": (
        lambda o: with_exchanged(o, of_kind(o, "again"), replies=()),
        "got no answer that was due (again)",
    ),
    "two": (
        lambda o: with_exchanged(o, at_rest(o), replies=2 * (reply_at_rest(o),)),
        "2 answers",
    ),
    "stale": (
        lambda o: with_exchanged(o, of_kind(o, "nothing"), replies=(bytes(48),)),
        "had to get no answer",
    ),
    "short": (
        lambda o: with_exchanged(o, at_rest(o), replies=(reply_at_rest(o)[:-4],)),
        "was answered by",
    ),
    "no record": (lambda o: with_exchanged(o, at_rest(o), record=-1), "left no record"),
    "counted": (
        lambda o: with_life(o, 0, counters=replace(o.runs[0].counters, duplicates=0)),
        "duplicates is 0",
    ),
}  # fmt: skip


@pytest.mark.parametrize("what", ANSWERS)
def test_an_answer_out_of_order_is_found(observed: Observed, what: str) -> None:
    alter, text = ANSWERS[what]
    assert text in found(alter(observed), "replies")


def refused_instead(observed: Observed, index: int, modes: tuple[int, ...]) -> Observed:
    """A packet answered with these modes and the targets received."""
    one = observed.runs[0].exchanged[index]
    talk = heard(observed)[0].talks[0]
    n = talk.init.n_axes
    assert talk.init.arms is not None
    safe = oracle.safe_answer(oracle.parse(one.packet, n), talk.init.arms)
    axes = tuple(
        axis._replace(mode=modes[k % len(modes)] or axis.mode) for k, axis in enumerate(safe.axes)
    )
    return with_exchanged(observed, index, replies=(oracle.build(safe._replace(axes=axes)),))


def test_a_refusal_is_of_one_kind_or_the_other_and_only_where_axes_are_open(
    observed: Observed,
) -> None:
    closed = refused_instead(observed, at_rest(observed), (505,))
    assert "a refusal where nothing is open" in found(closed, "replies")
    some = refused_instead(observed, in_motion(observed)[0], (505, 0))
    assert "neither 505 in all axes nor one 508" in found(some, "replies")
    whole = refused_instead(observed, in_motion(observed)[0], (505,))
    # After it every open axis is to be refused until all were seen closed.
    assert "not seen closed since the last fault" in found(whole, "replies")


def test_no_set_point_is_answered_to_an_axis_that_closed(observed: Observed) -> None:
    index, offset = in_motion(observed)
    packet = bytearray(observed.runs[0].exchanged[index].packet)
    packet[offset : offset + 4] = bytes(4)
    closed = with_exchanged(observed, index, packet=bytes(packet))
    assert "not open: not the safe answer" in found(closed, "replies")


def test_the_safe_answers_on_arrays_are_those_of_the_oracle_one_by_one() -> None:
    chance = random.Random(4)
    arms = (1, 1, 2, 1)
    modes = [0, 1, 2, 3, 4, 5, 7, 9, 10, 11, 12, 17, 500, 501, 502, 504, 508, -1]
    packets = []
    for _ in range(400):
        axes = tuple(
            oracle.Axis(chance.choice(modes), tuple(chance.randbytes(4) for _ in range(8)))
            for _ in arms
        )
        status = bytes(chance.choice((0, 1, 5, 5, 255)) for _ in range(4))
        packets.append(
            oracle.build(oracle.Packet(chance.randint(1, 0x7FFF), status, bytes(4), axes))
        )
    ours = safe_answers(Packets.of(packets, 4), arms)
    for row, packet in enumerate(packets):
        theirs = oracle.safe_answer(oracle.parse(packet, 4), arms)
        assert bytes(ours.status[row]) == theirs.status
        for slot, axis in enumerate(theirs.axes):
            assert (
                ours.words[row, slot].tobytes()
                == oracle.build(oracle.Packet(0, bytes(4), bytes(4), (axis,)))[12:]
            )


# Set-points ---------------------------------------------------------------------------------


def with_set_points(
    observed: Observed, move: Callable[[np.ndarray], np.ndarray], *, records: bool = True
) -> Observed:
    """The set-points of a motion of the first life moved by `move(rows)` motor revolutions."""
    life = observed.runs[0]
    talk = heard(observed)[0].talks[0]
    stretch = max(stretches(talk), key=lambda one: one.leading)
    slots = list(talk.init.slots or ())
    drives, k = observed.cell.drive_train, stretch.leading
    moved = np.zeros_like(stretch.sent[:k]) + move(np.arange(k))
    steps = stretch.step[:k] + np.diff(moved, axis=0, prepend=moved[:1])
    exchanged, rows = list(life.exchanged), life.records.copy()
    for number, index in enumerate(stretch.at[:k]):
        one = exchanged[index]
        q = rows["commanded_position"][one.record] + drives.joint_position(moved[number])
        q -= drives.joint_position(np.zeros_like(q))
        sent = np.array([drives.motor_revolutions(q), steps[number]], np.float32)
        reply = bytearray(one.replies[0])
        for joint, slot in enumerate(slots):
            reply[16 + 36 * slot : 24 + 36 * slot] = sent[:, joint].tobytes()
        exchanged[index] = one._replace(replies=(bytes(reply),))
        if records:
            rows["commanded_position"][one.record] = q
    return with_life(observed, 0, exchanged=tuple(exchanged), records=rows)


def bump(height: float, at: int) -> Callable[[np.ndarray], np.ndarray]:
    return lambda rows: np.where(rows == at, height, 0.0)[:, np.newaxis]


def middle(observed: Observed) -> int:
    return max(one.leading for one in stretches(heard(observed)[0].talks[0])) // 2


def test_a_set_point_that_leaps_passes_no_bound(observed: Observed) -> None:
    leapt = with_set_points(observed, bump(0.2, middle(observed)))
    said = found(leapt, "guard")
    for text in ("acceleration", "jerk", "recorded set-points", "float32 set-points"):
        assert text in said


def test_a_set_point_that_leaps_on_the_wire_alone_is_found_as_well(observed: Observed) -> None:
    leapt = with_set_points(observed, bump(0.2, middle(observed)), records=False)
    said = found(leapt, "guard")
    assert "not the recorded one" in said
    assert "float32 set-points" in said


def test_a_jerk_that_only_the_records_can_show_is_found(observed: Observed) -> None:
    """Four millionths of a revolution: below a step of float32 at 100 revolutions."""
    limits, period = observed.cell.joint_limits, observed.cell.period
    gears = np.abs(np.diag(observed.cell.drive_train.motor_from_joint)) / (2.0 * np.pi)
    height = float(np.max(4.0 * limits.jerk * period**3 * gears))
    said = found(with_set_points(observed, bump(height, middle(observed))), "guard")
    assert "jerk" in said
    assert "velocity" not in said


def test_a_set_point_beyond_the_range_is_found(observed: Observed) -> None:
    limits = observed.cell.joint_limits
    way = float(np.max(limits.upper - limits.lower))
    beyond = with_set_points(observed, lambda rows: np.full((len(rows), 1), 200.0 * way))
    assert "outside the joints' range" in found(beyond, "guard")


def test_the_first_set_point_is_the_target_received(observed: Observed) -> None:
    talk = heard(observed)[0].talks[0]
    offset = 16 + 36 * (talk.init.slots or (0,))[0]
    moved = with_answer(observed, first_set_point(observed), offset + 1, 8)
    assert "not the target received" in found(moved, "guard")
    packet = bytearray(observed.runs[0].exchanged[first_set_point(observed)].packet)
    packet[offset + 12 : offset + 16] = np.float32(0.01).tobytes()  # D4, motor rev. per cycle
    running = with_exchanged(observed, first_set_point(observed), packet=bytes(packet))
    assert "in motion" in found(running, "guard")


@pytest.mark.parametrize(
    ("field", "value", "text"),
    [(0, 1e3, "target is elsewhere"), (2, 1e3, "does not follow"), (4, 1e4, "current limit")],
)
def test_set_points_go_only_to_an_arm_that_follows(
    observed: Observed, field: int, value: float, text: str
) -> None:
    index, offset = in_motion(observed)
    packet = bytearray(observed.runs[0].exchanged[index].packet)
    at = offset + 4 + 4 * field
    packet[at : at + 4] = np.float32(value).tobytes()
    assert text in found(with_exchanged(observed, index, packet=bytes(packet)), "guard")


def test_nothing_moves_that_was_not_requested_or_has_ended(observed: Observed) -> None:
    life = observed.runs[0]
    unasked = with_life(observed, 0, acts=tuple(a for a in life.acts if a.name != "request"))
    assert "before any motion was requested" in found(unasked, "guard")
    early = tuple(
        (at, replace(one, cycle=one.cycle - 150) if isinstance(one, MotionEnded) else one)
        for at, one in life.events
    )
    ended = with_life(observed, 0, events=early)
    assert "after the motion had ended" in found(ended, "guard")


def test_the_judge_of_single_packets_finds_the_same(observed: Observed) -> None:
    leapt = with_set_points(observed, bump(0.2, middle(observed)))
    assert "velocity" in found(leapt, "judge")
    assert "safe answer" in found(with_answer(observed, at_rest(observed), 17), "judge")


def test_bounds_of_a_stop_for_losses_that_were_none_are_found(observed: Observed) -> None:
    """The session says that answers were lost; only the judge counts them itself."""
    limits, period = observed.cell.joint_limits, observed.cell.period
    gears = np.abs(np.diag(observed.cell.drive_train.motor_from_joint)) / (2.0 * np.pi)
    height = float(np.min(0.6 * limits.jerk * period**3 * gears))
    wide = with_set_points(observed, bump(height, middle(observed)))
    assert "jerk" in found(wide, "guard")
    talk = heard(observed)[0].talks[0]
    stretch = max(stretches(talk), key=lambda one: one.leading)
    lost = AnswersLost(3, int(talk.records["cycle"][stretch.rows][0]))
    events = observed.runs[0].events
    wide = with_life(wide, 0, events=(*events, (events[-1][0], lost)))
    assert found(wide, "guard") == ""
    assert "jerk" in found(wide, "judge")


# The arm ------------------------------------------------------------------------------------


def test_an_arm_that_ends_moving_or_open_is_found(observed: Observed) -> None:
    arm = observed.arm
    fast = replace(observed, arm=replace(arm, velocity=arm.velocity + 1.0))
    assert "the arm moves at the end" in found(fast, "rest")
    assert "ends on a moving arm" in found(fast, "rest")
    opened = replace(observed, arm=replace(arm, open_axes=np.ones(len(arm.phase), bool)))
    assert "axes are open at the end" in found(opened, "rest")
