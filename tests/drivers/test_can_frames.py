"""What cyclic frames carry, in both profiles: fields, modes, answers, ages."""

from __future__ import annotations

import numpy as np
import pytest

from drivers import CyclicPacket, Mode
from drivers.packets import next_number
from drivers.transports.can.bus_load import CanModeError, CanValueError
from drivers.transports.can.codecs import NEVER, Sent, words_of
from drivers.transports.can.layout import CLASSIC_MODE_CODES, FD_MODE_CODES
from tests.drivers.can_bench import PROFILES, N, Wire, decoded, init_packet, random_packet
from tests.drivers.rig import running, smooth_move

MODES = {"fd": FD_MODE_CODES, "classic": CLASSIC_MODE_CODES}
STEP = 2.0**-16


@pytest.fixture(params=PROFILES)
def profile(request):
    return request.param


@pytest.fixture
def wire(profile):
    return Wire(profile)


def packet(number, *, mode=4, status=5, d=None, extra=None, n_axes=N):
    made = CyclicPacket.zeros(number, n_axes)
    made.axes["mode"] = mode
    if d is not None:
        made.axes["d"] = d
    if extra is not None:
        made.axes["extra"] = extra
    return CyclicPacket(number, bytes((status, 0, 0, 0)), bytes(4), made.axes).encode()


def answer(number, *, mode=4, status=0, d=None, n_axes=N):
    return packet(next_number(number), mode=mode, status=status, d=d, n_axes=n_axes)


@pytest.mark.parametrize("n_axes", range(1, 7))
def test_one_to_six_axes_pass_both_ways(profile, n_axes):
    wire = Wire(profile, n_axes=n_axes)
    rng = np.random.default_rng(n_axes)
    sent = random_packet(rng, 11, n_axes)
    got = decoded(wire.up(sent), n_axes)
    wanted = decoded(sent, n_axes)
    for column in (0, 2, 4):
        np.testing.assert_array_equal(got.axes["d"][:, column], wanted.axes["d"][:, column])
    assert wire.near.ages.shape == (n_axes, 8)
    back = np.zeros((n_axes, 5))
    back[:, 0] = rng.integers(-(2**20), 2**20, n_axes) * STEP
    reply = decoded(wire.down(answer(11, d=back, n_axes=n_axes)), n_axes)
    np.testing.assert_array_equal(reply.axes["d"][:, 0], back[:, 0])


def test_every_mode_of_the_profile_passes_up(profile, wire):
    for number, mode in enumerate(MODES[profile], start=11):
        assert (decoded(wire.up(packet(number, mode=mode))).axes["mode"] == mode).all()
        assert not wire.far.segmented


@pytest.mark.parametrize("mode", [18, 499, 509, -1, 2**31 - 1])
def test_a_packet_that_frames_cannot_carry_goes_whole_as_segments(wire, mode):
    odd = packet(11, mode=mode)
    assert wire.up(odd) == odd
    assert wire.far.segmented
    assert wire.near.ages is None
    back = answer(11, mode=0)
    assert wire.down(back) == back


@pytest.mark.parametrize("length", [12, 48, 227, 229, 732])
def test_packets_of_another_length_go_whole_as_segments(wire, length):
    odd = packet(11)[:length].ljust(length, b"\x55")
    assert wire.up(odd) == odd


def test_each_axis_has_its_own_mode_and_the_status_passes(wire):
    modes = [0, 4, 5, 7, 501, 4]
    got = decoded(wire.up(packet(11, mode=modes, status=3)))
    assert got.axes["mode"].tolist() == modes
    assert got.status == bytes((3, 0, 0, 0))


# Slow values and their ages.


def test_after_25_cycles_every_slow_value_is_known_and_its_age_is_right(wire):
    rng = np.random.default_rng(3)
    sent = {}
    for number in range(11, 36):
        sent[number] = random_packet(rng, number)
        got = words_of(wire.up(sent[number]), N)
    ages = wire.near.ages
    assert sorted(ages[:, [1, 5, 6, 7]].ravel()) == list(range(1, 25))
    for column in (2, 6, 7, 8):
        for axis in range(N):
            source = words_of(sent[35 - int(ages[axis, column - 1])], N)
            assert got[axis, column] == source[axis, column]


def test_fewer_axes_take_turns_faster(profile):
    wire = Wire(profile, n_axes=2)
    for number in range(11, 20):
        wire.up(packet(number, n_axes=2))
    assert wire.near.ages.max() == 8


def test_the_functionality_word_takes_its_turn(wire):
    rng = np.random.default_rng(4)
    sent = [random_packet(rng, number) for number in range(11, 36)]
    got = [wire.up(each)[8:12] for each in sent]
    assert got[-2] == bytes(4)
    assert got[-1] == sent[-1][8:12]


def test_after_silence_nothing_slow_is_known(wire):
    for number in range(11, 40):
        wire.up(packet(number))
    wire.near.forget()
    got = decoded(wire.up(packet(2000)))
    assert np.isnan(got.axes["extra"][:, 1:]).all()
    assert (wire.near.ages == NEVER).sum() >= 23


def test_a_new_init_packet_starts_over(wire):
    for number in range(11, 40):
        wire.up(packet(number))
    assert wire.up(init_packet()) == init_packet()
    wire.up(packet(11))
    assert (wire.near.ages == NEVER).sum() >= 23


# The classic profile's rounding.


def test_classic_positions_are_rounded_to_one_increment_of_a_16_bit_encoder():
    wire = Wire("classic")
    rng = np.random.default_rng(5)
    d = np.zeros((N, 5))
    d[:, 2] = rng.uniform(-255, 255, N)
    d[:, 0] = d[:, 2] + rng.uniform(-0.9, 0.9, N)
    d[:, 4] = rng.uniform(-31, 31, N)
    got = decoded(wire.up(packet(11, d=d))).axes["d"]
    np.testing.assert_allclose(got[:, 2], d[:, 2], rtol=0, atol=0.51 * STEP)
    np.testing.assert_allclose(got[:, 0], d[:, 0], rtol=0, atol=0.51 * STEP)
    np.testing.assert_allclose(got[:, 4], d[:, 4], rtol=0, atol=0.51 / 64)


def test_a_classic_target_at_rest_does_not_tremble_with_the_encoder():
    """D1 is sent as a difference to D3, yet comes out the same whatever D3 is."""
    wire = Wire("classic")
    rng = np.random.default_rng(6)
    targets = set()
    for number in range(11, 61):
        d = np.zeros((N, 5))
        d[:, 0] = 12.3456789
        d[:, 2] = 12.3456789 + rng.normal(0.0, 3 * STEP, N)
        targets |= set(decoded(wire.up(packet(number, d=d))).axes["d"][:, 0].tolist())
    assert len(targets) == 1


@pytest.mark.parametrize(
    ("column", "value", "lost"),
    [
        (2, 1024.0, (0, 2, 3)),
        (2, -1024.0, (0, 2, 3)),
        (2, 1025.5, (0, 2, 3)),
        (2, -3000.0, (0, 2, 3)),
        (2, np.nan, (0, 2, 3)),
        (2, -np.inf, (0, 2, 3)),
        (0, 1.0, (0,)),
        (0, -1.0, (0,)),
        (0, 2.25, (0,)),
        (0, -1.5, (0,)),
        (0, np.inf, (0,)),
        (4, 32.0, (4,)),
        (4, -32.0, (4,)),
        (4, 65.0, (4,)),
        (4, np.nan, (4,)),
    ],
)
def test_a_classic_number_outside_its_field_is_no_number_at_all(column, value, lost):
    wire = Wire("classic")
    wire.up(packet(11))
    d = np.zeros((N, 5))
    d[3, column] = value
    got = decoded(wire.up(packet(12, d=d))).axes["d"]
    expected = np.zeros((N, 5), bool)
    expected[3, list(lost)] = True
    np.testing.assert_array_equal(np.isnan(got[:, [0, 2, 3, 4]]), expected[:, [0, 2, 3, 4]])


def test_the_largest_classic_numbers_pass():
    wire = Wire("classic")
    d = np.zeros((N, 5))
    d[:, 2] = [255.0, -255.0, 1023.0, -1023.0, 0.5, 0.0]
    d[:, 0] = d[:, 2] + [1 - STEP, STEP - 1, 0.5, -0.5, 0.0, 0.0]
    d[:, 4] = [31.984375, -31.984375, 0.0, 0.0, 0.0, 0.0]
    got = decoded(wire.up(packet(11, d=d))).axes["d"]
    for column in (0, 2, 4):
        np.testing.assert_array_equal(got[:, column], d[:, column].astype(np.float32))


def test_classic_velocity_is_the_step_of_the_position():
    wire = Wire("classic")
    velocity = []
    for number, position in ((11, 1.0), (12, 1.25), (13, 1.75), (16, 2.5)):
        d = np.zeros((N, 5))
        d[:, 2] = d[:, 0] = position
        wire.time += 0.006
        velocity.append(decoded(wire.up(packet(number, d=d))).axes["d"][0, 3])
        velocity.append(int(wire.near.ages[0, 3]))
    assert np.isnan(velocity[0])
    assert velocity[1:] == [NEVER, 0.25, 0, 0.5, 0, 0.25, 2], "a mean over what was missed"


def test_a_classic_answer_carries_the_step_of_its_set_points():
    wire = Wire("classic")
    steps = []
    for number, target in ((11, 1.0), (12, 1.25), (13, 1.75), (16, 2.5)):
        wire.time += 0.006
        wire.up(packet(number))
        d = np.zeros((N, 5))
        d[:, 0] = target
        steps.append(decoded(wire.down(answer(number, d=d))).axes["d"][0, 1])
    assert steps == [0.0, 0.25, 0.5, 0.25]


@pytest.mark.parametrize(("ahead", "step"), [(16, 0.25), (17, 0.0)])
def test_a_classic_step_does_not_reach_back_over_a_long_gap(ahead, step):
    wire = Wire("classic")
    d = np.zeros((N, 5))
    for number, target in ((11, 1.0), (11 + ahead, 5.0)):
        wire.time += 0.1
        wire.up(packet(number))
        d[:, 0] = target
        got = decoded(wire.down(answer(number, d=d))).axes["d"]
    assert (got[:, 1] == step).all()


def test_a_classic_step_does_not_reach_back_over_another_answer():
    wire = Wire("classic")
    d = np.zeros((N, 5))
    for number, mode in ((11, 4), (12, 505), (13, 4)):
        wire.up(packet(number))
        d[:, 0] = number
        got = decoded(wire.down(answer(number, mode=mode, d=d if mode == 4 else None)))
        assert (got.axes["d"][:, 1] == 0.0).all()


# Answers.


@pytest.mark.parametrize("status", [0, 1, 7])
def test_an_echo_while_the_drive_is_off_is_the_controllers_own_packet(wire, status):
    """Bit for bit, though the PC knows some of it only rounded or aged."""
    for number in range(11, 15):
        sent = random_packet(np.random.default_rng(number), number, mode=0, status=status)
        seen = wire.up(sent)
        reply = next_number(number).to_bytes(4, "little") + seen[4:8] + bytes(4) + seen[12:]
        expected = next_number(number).to_bytes(4, "little") + sent[4:8] + bytes(4) + sent[12:]
        assert wire.down(reply) == expected


@pytest.mark.parametrize(("mode", "kept"), [(0, 2), (501, 2), (10, 5)])
def test_what_closed_axes_give_back_is_the_controllers_own_too(wire, mode, kept):
    sent = random_packet(np.random.default_rng(7), 11, mode=mode)
    seen = decoded(wire.up(sent)).axes.copy()
    seen["d"][:, kept:] = 0.0
    seen["extra"] = 0.0
    reply = CyclicPacket(12, bytes(4), bytes(4), seen).encode()
    wanted = decoded(sent).axes.copy()
    wanted["d"][:, kept:] = 0.0
    wanted["extra"] = 0.0
    assert wire.down(reply) == CyclicPacket(12, bytes(4), bytes(4), wanted).encode()


@pytest.mark.parametrize("mode", [505, 508])
def test_drive_off_and_following_error_pass_axis_by_axis(wire, mode):
    wire.up(packet(11))
    modes = [4, 4, mode, 4, mode, 4]
    d = np.zeros((N, 5))
    d[:, 0] = 0.5
    got = decoded(wire.down(answer(11, mode=modes, d=d)))
    assert got.axes["mode"].tolist() == modes
    still = np.array(modes) == 4
    assert (got.axes["d"][still, 0] == 0.5).all()


@pytest.mark.parametrize("modes", [[4] * 6, [0] * 6, [0, 4, 0, 4, 4, 0], [7, 8, 9, 2, 1, 5]])
def test_the_exit_from_open_mode_passes_whatever_the_axes_do(wire, modes):
    wire.up(packet(11, mode=modes))
    got = decoded(wire.down(answer(11, mode=modes, status=1)))
    assert got.status == bytes((1, 0, 0, 0))
    assert got.axes["mode"].tolist() == modes
    wire.up(packet(12, mode=modes))
    assert decoded(wire.down(answer(12, mode=modes))).status == bytes(4)


@pytest.mark.parametrize("mode", [500, 502, 504, 506, 508])
def test_modes_that_are_not_available_are_answered_by_zeros(wire, mode):
    wire.up(packet(11, mode=mode, d=np.ones((N, 5))))
    got = decoded(wire.down(answer(11, mode=0)))
    assert (got.axes["mode"] == 0).all()
    assert not got.axes["d"].any()


def test_increments_of_position_pass_and_have_no_step(wire):
    d = np.zeros((N, 5))
    for number in (11, 12, 13):
        wire.up(packet(number, mode=7))
        d[:, 0] = 0.0625 * (number - 10)
        got = decoded(wire.down(answer(number, mode=7, d=d))).axes["d"]
        np.testing.assert_array_equal(got, d)


@pytest.mark.parametrize("mode", [1, 2, 8, 9, 10])
@pytest.mark.parametrize("column", [2, 3, 4])
def test_answers_that_need_more_than_two_numbers_are_refused(wire, mode, column):
    wire.up(packet(11, mode=mode))
    d = np.zeros((N, 5))
    d[4, column] = 0.25
    with pytest.raises(CanModeError, match=rf"mode {mode} \(slot 4\)"):
        wire.near.reply(answer(11, mode=mode, d=d))
    got = decoded(_taken(wire, wire.near.drive_off()))
    assert (got.axes["mode"] == 505).all()


def _taken(wire, frames):
    return [wire.far.receive(frame, wire.time) for frame in frames][-1]


@pytest.mark.parametrize("mode", [0, 3, 600])
def test_an_answer_in_a_mode_that_was_not_asked_is_refused_where_it_has_no_code(mode):
    wire = Wire("classic")
    wire.up(packet(11))
    d = np.zeros((N, 5))
    d[:, 0] = 1.0
    with pytest.raises(CanModeError):
        wire.near.reply(answer(11, mode=mode, d=d))


def test_a_status_that_is_not_asked_for_is_refused_in_classic_frames():
    wire = Wire("classic")
    wire.up(packet(11))
    with pytest.raises(CanModeError, match="status 9"):
        wire.near.reply(answer(11, status=9))


@pytest.mark.parametrize("field", ["D1", "D2"])
def test_what_is_not_finite_is_refused(wire, field):
    wire.up(packet(11))
    d = np.zeros((N, 5))
    d[2, ("D1", "D2").index(field)] = np.nan
    with pytest.raises(CanValueError, match=f"{field} of slot 2"):
        wire.near.reply(answer(11, d=d))


def test_an_answer_to_a_packet_before_the_last_still_finds_it(wire):
    seen = wire.up(packet(11, mode=0, status=0, d=np.ones((N, 5))))
    wire.up(packet(12))
    got = decoded(wire.down(next_number(11).to_bytes(4, "little") + seen[4:]))
    assert got.number == 12
    assert (got.axes["d"] == 1.0).all()


def test_an_answer_to_a_packet_long_ago_is_stale(wire):
    wire.up(packet(11))
    frames = wire.near.reply(answer(11))
    for number in range(12, 30):
        wire.up(packet(number))
    assert [wire.far.receive(frame, wire.time) for frame in frames] == [None] * len(frames)
    assert wire.far.discarded["stale"] == 1


def test_a_real_session_answers_over_frames_as_it_answers_over_packets(wire):
    """Every state of a session with a motion: the controller sees the same, to the rounding."""
    rig = running(smooth_move(np.full(N, 0.05), 250))
    rig.run()
    rig.cycle(mode=Mode.END_OF_SESSION)
    compared = 0
    for sent, reply in rig.transcript:
        if reply is None or len(sent) != len(packet(11)):
            continue
        wire.up(sent)
        got, wanted = decoded(_through(wire, sent, reply)), decoded(reply)
        assert got.number == wanted.number
        assert got.status == wanted.status
        np.testing.assert_array_equal(got.axes["mode"], wanted.axes["mode"])
        told = ~np.isin(wanted.axes["mode"], (505, 508))
        # A classic step is the difference of two positions rounded to half an increment each, of
        # which the wire's float32 (below 128 revolutions) had taken a quarter each before.
        np.testing.assert_allclose(
            got.axes["d"][told], wanted.axes["d"][told], rtol=0, atol=1.5 * STEP
        )
        compared += 1
    assert compared > 250


def _through(wire, sent, reply):
    """The session saw the packet itself; let the near end compare with what it saw there."""
    wire.near._sent.append(Sent.of(sent, N))
    return wire.down(reply)
