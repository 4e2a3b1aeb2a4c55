"""Captures of third-party programs, fed to our session; skipped where they are not at hand.

In `b_*` both ends are foreign: a controller of one laboratory and the driver of another. The
driver's answers are the reference wherever ours means to say the same. It differs by design in
modes 501 and 0, where the driver sends zeros and we give target position and velocity back (as
a second independent program did), and at 504, where it sends nothing and we answer once.
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from captures import CAPTURES, read_datagrams
from rig import Table

from drivers import (
    CycleRing,
    CyclicPacket,
    DriveTrain,
    Guard,
    GuardLimits,
    InitPacket,
    Mode,
    Session,
    State,
)
from drivers.packets import INIT_LENGTH, cyclic_length, next_number

N = 6
# Wide enough for float32 positions of a foreign program, whose third difference is noise.
WIDE = GuardLimits(
    lower=np.full(N, -100.0),
    upper=np.full(N, 100.0),
    velocity=np.full(N, 1e3),
    acceleration=np.full(N, 1e7),
    jerk=np.full(N, 1e10),
    following_error=np.full(N, 2.0),
    current=np.full(N, 10.0),
)


def conversation(shared_data: Path, name: str) -> list[tuple[bytes, bytes | None]]:
    """Each packet of the controller with the answer it got, if any."""
    pairs: list[tuple[bytes, bytes | None]] = []
    for datagram in read_datagrams(shared_data / "c4g_captures" / f"{name}.pcap"):
        if datagram.from_controller:
            pairs.append((datagram.payload, None))
        else:
            pairs[-1] = (pairs[-1][0], datagram.payload)
    return pairs


def session_for(init: InitPacket) -> Session:
    k54, k64, k65 = (float(np.nan_to_num(k)) for k in init.wrist_coupling())
    ratio = init.gear_ratio[0, :N].astype(np.float64)
    train = DriveTrain(
        gear_ratio=np.where(np.isfinite(ratio) & (ratio != 0.0), ratio, 100.0),
        calibration=np.nan_to_num(init.calibration[0, :N].astype(np.float64)),
        joint_sign=np.ones(N),
        joint_offset=np.zeros(N),
        torque_constant=np.ones(N),
        current_limit=np.full(N, 10.0),
        k54=k54,
        k64=k64,
        k65=k65,
    )
    return Session(train, Guard(WIDE, 0.002), CycleRing(N))


class ForeignMotion(Table):
    """The set-points the foreign driver sent, as joint positions."""

    def __init__(self, session: Session, targets: np.ndarray):
        super().__init__(session._drive_train.joint_position(targets))


@pytest.mark.parametrize("name", ["b_ufmg_mode4", "b_ufmg_fast"])
def test_answers_are_those_of_the_foreign_driver(shared_data: Path, name: str):
    pairs = conversation(shared_data, name)
    session = session_for(InitPacket.decode(pairs[0][0]))
    theirs = [CyclicPacket.decode(reply, N) for _, reply in pairs[1:] if reply is not None]
    targets = [
        reply.axes["d"][:, 0] for reply in theirs if (reply.axes["mode"] == Mode.POSITION).all()
    ]
    # One more row: this foreign motion was cut off by the controller, not at its end.
    session.request(ForeignMotion(session, np.array([*targets, targets[-1]], np.float64)))
    compared = dict.fromkeys((Mode.DRIVING_ON, Mode.CLOSED, Mode.POSITION), 0)
    for index, (packet, expected) in enumerate(pairs):
        reply = session.reply(packet, 0.002 * index)
        if len(packet) == INIT_LENGTH:
            assert reply == expected
            continue
        received, ours = CyclicPacket.decode(packet, N), CyclicPacket.decode(reply, N)
        mode = int(received.axes["mode"][0])
        assert ours.number == next_number(received.number)
        assert ours.functionality == bytes(4)
        assert not ours.axes["extra"].any()
        if mode == Mode.END_OF_SESSION:
            assert expected is None
            assert not ours.axes["d"].any()
            assert session.state is State.ENDED
            continue
        their = CyclicPacket.decode(expected, N)
        assert len(reply) == len(expected)
        assert (ours.number, ours.status) == (their.number, their.status)
        np.testing.assert_array_equal(ours.axes["mode"], their.axes["mode"])
        np.testing.assert_array_equal(ours.axes["d"][:, 2:], their.axes["d"][:, 2:])
        compared[mode] += 1
        if mode == Mode.POSITION:
            np.testing.assert_array_equal(ours.axes["d"][:, 0], their.axes["d"][:, 0])
            # The driver takes the step between two float32 positions.
            resolution = 2.0 * np.spacing(np.abs(their.axes["d"][:, 0])).max()
            np.testing.assert_allclose(ours.axes["d"][:, 1], their.axes["d"][:, 1], atol=resolution)
        else:
            assert not their.axes["d"].any()
            np.testing.assert_array_equal(ours.axes["d"][:, :2], received.axes["d"][:, :2])
    assert all(compared.values()), compared


def test_a_controller_with_an_impossible_axis_map_is_answered_but_never_moved(shared_data: Path):
    """Five axes that all claim slot 1, a cycle of 1500: the foreign driver moved one of them."""
    pairs = conversation(shared_data, "b_ufmg_literal")
    session = session_for(InitPacket.decode(pairs[0][0]))
    for index, (packet, expected) in enumerate(pairs):
        reply = session.reply(packet, 0.002 * index)
        if len(packet) == INIT_LENGTH:
            assert reply == expected
            continue
        received, ours = CyclicPacket.decode(packet, 5), CyclicPacket.decode(reply, 5)
        assert len(reply) == cyclic_length(5)
        mode = int(received.axes["mode"][0])
        if mode == Mode.POSITION:
            assert (ours.axes["mode"] == Mode.DRIVE_OFF_REQUEST).all()
        elif mode == Mode.END_OF_SESSION:
            assert not ours.axes["mode"].any()
        else:
            np.testing.assert_array_equal(ours.axes["mode"], received.axes["mode"])
            np.testing.assert_array_equal(ours.axes["d"][:, :2], received.axes["d"][:, :2])


@pytest.mark.parametrize("name", [name for name in CAPTURES if not name.startswith("s_")])
def test_every_foreign_packet_gets_exactly_one_answer_of_the_right_shape(
    shared_data: Path, name: str
):
    """Without a motion requested: whatever the controller reports, the arm is held or released."""
    pairs = conversation(shared_data, name)
    init = next(InitPacket.decode(p) for p, _ in pairs if len(p) == INIT_LENGTH)
    session = session_for(init)
    ended = False
    now, expected_number = 0.0, None
    for packet, _ in pairs:
        number = struct.unpack_from("<i", packet)[0]
        # One capture skips thousands of numbers; only a silence can explain that.
        now += 0.002 if expected_number in (None, number) else 60.0
        expected_number = next_number(number)
        reply = session.reply(packet, now)
        assert (reply is None) == ended
        if reply is None:
            continue
        assert struct.unpack_from("<i", reply)[0] == next_number(number)
        started = session.init is not None and session.state is not State.INIT
        assert len(reply) == (cyclic_length(init.n_axes) if started else len(packet))
        ended = session.state is State.ENDED
    assert session.counters.malformed == 0
