"""Controllers of the captures, with nothing for them to do: the arm is held, or let go of.

The other end's program moved the arm all the same, so the session sees an arm that leaves the
set-point it holds. What a motion is answered with is in `test_captures_answers`.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from drivers import FollowingError, MotionNotCarriedOn, Refused, State
from drivers.packets import INIT_LENGTH
from tests.drivers import oracle
from tests.drivers.captures import CAPTURES, conversation
from tests.drivers.test_captures_answers import MOVED, Replay, fields, replace_mode, replay_of

FOLLOWING_ERROR = 0.05
"""Motor revolutions, in the cell: narrower than what these controllers announce."""


class Holding:
    """The documented answers of a PC that holds the target received when the last axis opened."""

    def __init__(self) -> None:
        self.held: np.ndarray | None = None
        self.offending: int | None = None
        self.let_go = False

    def expected(self, received: oracle.Packet) -> oracle.Packet:
        answer = oracle.safe_answer(received, (1,) * len(received.axes))
        is_open = [axis.mode in oracle.OPEN for axis in received.axes]
        if received.status[0] != oracle.DRIVE_ON or not any(is_open):
            self.held = self.offending = None
            self.let_go = False
            return answer
        if not all(is_open):
            return answer
        d = np.array([axis.floats for axis in received.axes])
        if self.held is None:
            self.held = d[:, 0]
        away = np.abs(d[:, 2] - self.held) > FOLLOWING_ERROR
        away |= np.abs(d[:, 2] - d[:, 0]) > FOLLOWING_ERROR
        if self.offending is None and not self.let_go and away.any():
            self.offending = int(np.argmax(away))
        elsewhere = np.abs(d[:, 0] - self.held) > 0.1 * FOLLOWING_ERROR
        self.let_go = self.let_go or (self.offending is None and bool(elsewhere.any()))
        axes = list(answer.axes)
        if self.let_go:
            axes = [replace_mode(axis, oracle.DRIVE_OFF_REQUEST) for axis in axes]
        elif self.offending is not None:
            axes[self.offending] = replace_mode(axes[self.offending], oracle.FOLLOWING_ERROR)
        else:
            axes = [
                oracle.Axis(axis.mode, (struct.pack("<f", held), *(oracle.ZERO,) * 7))
                for axis, held in zip(axes, self.held, strict=True)
            ]
        return answer._replace(axes=tuple(axes))


def idle_replay(shared_data: Path, name: str) -> Replay:
    replay = replay_of(shared_data, name, following_error=FOLLOWING_ERROR)
    replay.requested = True  # as far as the replay knows, so that it asks for nothing
    return replay


@pytest.mark.parametrize("name", MOVED)
def test_without_a_motion_the_first_target_is_held_until_the_arm_has_left_it_too_far(
    shared_data: Path, name: str
):
    replay, holding = idle_replay(shared_data, name), Holding()
    for packet, _ in replay.pairs:
        ours = replay.feed(packet)
        if len(packet) == INIT_LENGTH or replay.session.state in (State.SYNC, State.INIT):
            assert ours == oracle.echo(packet)
            continue
        expected = holding.expected(oracle.parse(packet, 6))
        assert oracle.differences(oracle.parse(ours, 6), expected) == [], expected.number
    refused = replay.seen(Refused)
    assert all(isinstance(e.error, FollowingError | MotionNotCarriedOn) for e in refused)
    # Their target leaves the one held at once; the arm follows later.
    assert refused


@pytest.mark.parametrize("name", [name for name in CAPTURES if not name.startswith("s_")])
def test_every_foreign_packet_gets_exactly_one_answer_of_the_right_shape(
    shared_data: Path, name: str
):
    replay = Replay(conversation(shared_data, name), 5 if name == "b_ufmg_literal" else 6)
    replay.requested = True
    session = replay.session
    for index, (packet, _) in enumerate(replay.pairs):
        assert session.state is not State.ENDED, index
        reply = replay.feed(packet)
        assert reply is not None
        number = struct.unpack_from("<i", packet)[0]
        assert struct.unpack_from("<i", reply)[0] == oracle.answer_number(number)
        started = session.init is not None and session.state is not State.INIT
        assert len(reply) == (oracle.length(session.init.n_axes) if started else len(packet))
    assert session.state is State.ENDED
    again = oracle.parse(replay.pairs[-1][0], replay.n)
    assert replay.feed(oracle.build(again._replace(number=again.number + 1))) is None
    assert session.counters.malformed == session.counters.stale == 0
    assert session.counters.ended == 1


def test_the_answers_compared_here_are_not_all_alike(shared_data: Path):
    """The reference itself tells held from let go: its answers to one capture differ in kind."""
    holding, kinds = Holding(), set()
    for packet, _ in conversation(shared_data, "a_mode4"):
        if len(packet) == oracle.length(6):
            received = oracle.parse(packet, 6)
            expected = holding.expected(received)
            same = fields(oracle.differences(expected, received)) - {"number"}
            kinds.add((expected.axes[0].mode, *sorted(same)))
    assert len(kinds) >= 4, kinds
