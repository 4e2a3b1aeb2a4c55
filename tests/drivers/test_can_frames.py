"""What cyclic frames carry, in both profiles, and the DBC files that say so, read by cantools."""

from __future__ import annotations

import zlib
from pathlib import Path

import cantools
import numpy as np
import pytest

from drivers.packets import CyclicPacket, Mode, next_number
from drivers.transports.can import ends
from drivers.transports.can.codecs import NEVER, words_of
from drivers.transports.can.ends import ControllerEnd
from drivers.transports.can.layout import (
    CLASSIC_MODE_CODES,
    FD_MODE_CODES,
    BusRates,
    CanModeError,
    CanValueError,
)
from tests.drivers.can_bench import PROFILES, N, Wire, decoded, init_packet, random_packet

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
def test_one_to_six_axes_in_both_directions(profile, n_axes):
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


def test_modes_of_the_profile(profile, wire):
    for number, mode in enumerate(MODES[profile], start=11):
        assert (decoded(wire.up(packet(number, mode=mode))).axes["mode"] == mode).all()
        assert not wire.far.segmented


@pytest.mark.parametrize(
    "raw",
    [
        *(packet(11, mode=mode) for mode in (18, 499, 509, -1, 2**31 - 1)),
        *(packet(11)[:length].ljust(length, b"\x55") for length in (12, 48, 227, 229, 732)),
    ],
    ids=lambda raw: f"{raw[12:16].hex()}, {len(raw)} bytes",
)
def test_other_packets_are_sent_as_segments(wire, raw):
    assert wire.up(raw) == raw
    assert wire.far.segmented
    assert wire.near.ages is None
    if len(raw) == 228:
        back = answer(11, mode=0)
        assert wire.down(back) == back


def test_mode_of_each_axis_and_status(wire):
    modes = [0, 4, 5, 7, 501, 4]
    got = decoded(wire.up(packet(11, mode=modes, status=3)))
    assert got.axes["mode"].tolist() == modes
    assert got.status == bytes((3, 0, 0, 0))


# Slow values and their ages.


def test_slow_values_and_ages_after_25_cycles(wire):
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


def test_slow_values_of_two_axes_repeat_faster(profile):
    wire = Wire(profile, n_axes=2)
    for number in range(11, 20):
        wire.up(packet(number, n_axes=2))
    assert wire.near.ages.max() == 8


def test_functionality_word_is_a_slow_value(wire):
    rng = np.random.default_rng(4)
    sent = [random_packet(rng, number) for number in range(11, 36)]
    got = [wire.up(each)[8:12] for each in sent]
    assert got[-2] == bytes(4)
    assert got[-1] == sent[-1][8:12]


@pytest.mark.parametrize("again", [False, True], ids=["silence", "init packet"])
def test_slow_values_are_unknown_after_a_restart(wire, again):
    for number in range(11, 40):
        wire.up(packet(number))
    if again:
        assert wire.up(init_packet()) == init_packet()
    else:
        wire.near.forget()
    got = decoded(wire.up(packet(11 if again else 2000)))
    assert np.isnan(got.axes["extra"][:, 1:]).all()
    assert (wire.near.ages == NEVER).sum() >= 23


# The classic profile's rounding.


def test_classic_positions_are_rounded_to_16_bit_increments():
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


def test_classic_target_does_not_depend_on_the_position():
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
    ("column", "values", "lost"),
    [
        (2, (1024.0, -1024.0, 1025.5, -3000.0, np.nan, -np.inf), (0, 2, 3)),
        (0, (1.0, -1.0, 2.25, -1.5, np.inf), (0,)),
        (4, (32.0, -32.0, 65.0, np.nan), (4,)),
    ],
)
def test_classic_number_outside_its_field_is_nan(column, values, lost):
    for value in values:
        wire = Wire("classic")
        wire.up(packet(11))
        d = np.zeros((N, 5))
        d[3, column] = value
        got = decoded(wire.up(packet(12, d=d))).axes["d"]
        expected = np.zeros((N, 5), bool)
        expected[3, list(lost)] = True
        np.testing.assert_array_equal(np.isnan(got[:, [0, 2, 3, 4]]), expected[:, [0, 2, 3, 4]])


def test_largest_classic_numbers():
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


def test_classic_reply_has_the_step_of_its_set_points():
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
def test_classic_step_is_zero_after_a_long_gap(ahead, step):
    wire = Wire("classic")
    d = np.zeros((N, 5))
    for number, target in ((11, 1.0), (11 + ahead, 5.0)):
        wire.time += 0.1
        wire.up(packet(number))
        d[:, 0] = target
        got = decoded(wire.down(answer(number, d=d))).axes["d"]
    assert (got[:, 1] == step).all()


def test_classic_step_is_zero_after_another_reply():
    wire = Wire("classic")
    d = np.zeros((N, 5))
    for number, mode in ((11, 4), (12, 505), (13, 4)):
        wire.up(packet(number))
        d[:, 0] = number
        got = decoded(wire.down(answer(number, mode=mode, d=d if mode == 4 else None)))
        assert (got.axes["d"][:, 1] == 0.0).all()


# Answers.


@pytest.mark.parametrize("status", [0, 1, 7])
def test_echo_with_the_drive_off_is_the_packet_sent(wire, status):
    """Bit for bit, though the PC knows some of it only rounded or aged."""
    for number in range(11, 15):
        sent = random_packet(np.random.default_rng(number), number, mode=0, status=status)
        seen = wire.up(sent)
        reply = next_number(number).to_bytes(4, "little") + seen[4:8] + bytes(4) + seen[12:]
        expected = next_number(number).to_bytes(4, "little") + sent[4:8] + bytes(4) + sent[12:]
        assert wire.down(reply) == expected


@pytest.mark.parametrize(("mode", "returned"), [(0, 2), (501, 2), (10, 5)])
def test_words_returned_by_closed_axes_are_those_sent(wire, mode, returned):
    sent = random_packet(np.random.default_rng(7), 11, mode=mode)
    seen = decoded(wire.up(sent)).axes.copy()
    seen["d"][:, returned:] = 0.0
    seen["extra"] = 0.0
    reply = CyclicPacket(12, bytes(4), bytes(4), seen).encode()
    wanted = decoded(sent).axes.copy()
    wanted["d"][:, returned:] = 0.0
    wanted["extra"] = 0.0
    assert wire.down(reply) == CyclicPacket(12, bytes(4), bytes(4), wanted).encode()


@pytest.mark.parametrize("mode", [505, 508])
def test_drive_off_and_following_error_per_axis(wire, mode):
    wire.up(packet(11))
    modes = [4, 4, mode, 4, mode, 4]
    d = np.zeros((N, 5))
    d[:, 0] = 0.5
    got = decoded(wire.down(answer(11, mode=modes, d=d)))
    assert got.axes["mode"].tolist() == modes
    still = np.array(modes) == 4
    assert (got.axes["d"][still, 0] == 0.5).all()


@pytest.mark.parametrize("mode", [500, 502, 504, 506, 508])
def test_zeros_in_reply_to_other_modes(wire, mode):
    wire.up(packet(11, mode=mode, d=np.ones((N, 5))))
    got = decoded(wire.down(answer(11, mode=0)))
    assert not got.axes["mode"].any()
    assert not got.axes["d"].any()


@pytest.mark.parametrize("modes", [[4] * 6, [0] * 6, [0, 4, 0, 4, 4, 0], [7, 8, 9, 2, 1, 5]])
def test_exit_request_passes_in_any_modes(wire, modes):
    wire.up(packet(11, mode=modes))
    got = decoded(wire.down(answer(11, mode=modes, status=1)))
    assert got.status == bytes((1, 0, 0, 0))
    assert got.axes["mode"].tolist() == modes
    wire.up(packet(12, mode=modes))
    assert decoded(wire.down(answer(12, mode=modes))).status == bytes(4)


def test_increments_of_position_have_no_step(wire):
    d = np.zeros((N, 5))
    for number in (11, 12, 13):
        wire.up(packet(number, mode=7))
        d[:, 0] = 0.0625 * (number - 10)
        got = decoded(wire.down(answer(number, mode=7, d=d))).axes["d"]
        np.testing.assert_array_equal(got, d)


@pytest.mark.parametrize("mode", [1, 2, 8, 9, 10])
@pytest.mark.parametrize("column", [2, 3, 4])
def test_reply_with_more_than_two_numbers_is_refused(wire, mode, column):
    wire.up(packet(11, mode=mode))
    d = np.zeros((N, 5))
    d[4, column] = 0.25
    with pytest.raises(CanModeError, match=rf"mode {mode} \(slot 4\)"):
        wire.near.reply(answer(11, mode=mode, d=d))
    got = decoded([wire.far.receive(each, wire.time) for each in wire.near.drive_off()][-1])
    assert (got.axes["mode"] == 505).all()


NOT_FINITE = {
    name: np.where(np.arange(N * 5).reshape(N, 5) == 10 + column, np.nan, 0.0)
    for column, name in enumerate(("D1", "D2"))
}


@pytest.mark.parametrize(
    ("profile", "changes", "error", "words"),
    [
        *(
            ("classic", {"mode": mode, "d": np.eye(N, 5)}, CanModeError, f"mode {mode}")
            for mode in (0, 3, 600)
        ),
        ("classic", {"status": 9}, CanModeError, "status 9"),
        *(
            (profile, {"d": d}, CanValueError, f"{field} of slot 2")
            for field, d in NOT_FINITE.items()
            for profile in PROFILES
        ),
    ],
)
def test_reply_without_code_or_finite_number_is_refused(profile, changes, error, words):
    wire = Wire(profile)
    wire.up(packet(11))
    with pytest.raises(error, match=words):
        wire.near.reply(answer(11, **changes))


def test_reply_to_the_packet_before_the_last(wire):
    seen = wire.up(packet(11, mode=0, status=0, d=np.ones((N, 5))))
    wire.up(packet(12))
    got = decoded(wire.down(next_number(11).to_bytes(4, "little") + seen[4:]))
    assert got.number == 12
    assert (got.axes["d"] == 1.0).all()


def test_reply_to_an_old_packet_is_stale(wire):
    wire.up(packet(11))
    frames = wire.near.reply(answer(11))
    for number in range(12, 30):
        wire.up(packet(number))
    assert [wire.far.receive(frame, wire.time) for frame in frames] == [None] * len(frames)
    assert wire.far.discarded["stale"] == 1


CODES = {"fd": FD_MODE_CODES, "classic": CLASSIC_MODE_CODES}
AXES = range(1, N + 1)
FOLDER = Path(ends.__file__).parent
SLOW_FIELDS = ("D2", "extra1", "extra2", "extra3")


@pytest.fixture(scope="module", params=PROFILES)
def described(request):
    return request.param


@pytest.fixture(scope="module")
def database(described):
    return cantools.database.load_file(FOLDER / f"c4g_open_{described}.dbc", strict=True)


def decode_all(database, frames):
    """Signals by frame name."""
    signals = {}
    for frame in frames:
        message = database.get_message_by_frame_id(frame.id)
        assert len(frame.data) == message.length
        signals[message.name] = message.decode(frame.data, decode_choices=False)
    return signals


def as_bits(values):
    return np.array(values, np.float32).view(np.int32)


def test_cantools_reads_packets(described, database):
    end = ControllerEnd(BusRates(described))
    end.packet(init_packet())
    seen = set()
    for number in range(11, 36):
        packet = random_packet(np.random.default_rng(number), number)
        signals = decode_all(database, end.packet(packet))
        wanted = decoded(packet)
        check_up(described, signals, wanted)
        seen |= check_slow(signals["UP_B" if described == "fd" else "UP_HEADER"], wanted)
    assert len(seen) == 25, "each slow value had its turn"


def check_up(described, signals, wanted):
    modes = [CODES[described][mode] for mode in wanted.axes["mode"].tolist()]
    d = wanted.axes["d"]
    if described == "fd":
        a, b = signals["UP_A"], signals["UP_B"]
        assert a["number"] == b["number"] == wanted.number
        assert b["status"] == wanted.status[0]
        assert [a[f"mode_axis{k}"] for k in AXES] == modes
        d4 = [(a if k <= 2 else b)[f"D4_axis{k}"] for k in AXES]
        columns = {0: "D1", 2: "D3"}
        for column, name in columns.items():
            read = [a[f"{name}_axis{k}"] for k in AXES]
            np.testing.assert_array_equal(as_bits(read), as_bits(d[:, column]))
        np.testing.assert_array_equal(as_bits(d4), as_bits(d[:, 3]))
        np.testing.assert_array_equal(as_bits([b[f"D5_axis{k}"] for k in AXES]), as_bits(d[:, 4]))
        return
    header, axes = signals["UP_HEADER"], [signals[f"UP_AXIS_{k}"] for k in AXES]
    assert header["number"] == wanted.number
    assert header["status"] == wanted.status[0]
    assert [axis["mode"] for axis in axes] == modes
    assert {axis["counter"] for axis in axes} == {wanted.number % 16}
    np.testing.assert_array_equal([axis["D3"] for axis in axes], d[:, 2])
    np.testing.assert_array_equal([axis["D3"] + axis["D1_minus_D3"] for axis in axes], d[:, 0])
    np.testing.assert_array_equal([axis["D5"] for axis in axes], d[:, 4])


def check_slow(signals, wanted):
    """The one slow value of this cycle; returns its name."""
    values = {"D2": wanted.axes["d"][:, 1]}
    values |= {f"extra{k}": wanted.axes["extra"][:, k - 1] for k in (1, 2, 3)}
    names = {name for name in signals if name.split("_")[0] in SLOW_FIELDS}
    if "functionality" in signals:
        assert signals["functionality"].to_bytes(4, "little") == wanted.functionality
        return {"functionality"}
    (name,) = names
    field, axis = name.split("_axis")
    assert as_bits([signals[name]])[0] == as_bits([values[field][int(axis) - 1]])[0]
    return names


def test_mode_codes_have_the_names_of_the_modes(described, database):
    name = "UP_A" if described == "fd" else "UP_AXIS_1"
    signal = next(
        s for s in database.get_message_by_name(name).signals if s.name in ("mode", "mode_axis1")
    )
    assert {message.is_fd for message in database.messages} == {described == "fd"}
    choices = {code: str(choice) for code, choice in signal.choices.items()}
    known = {int(mode): mode.name.lower() for mode in Mode}
    names = {code: known.get(mode, f"mode_{mode}") for mode, code in CODES[described].items()}
    assert choices == names


def test_cantools_reads_the_head_of_a_segmented_packet(described, database):
    packet = init_packet()
    head = ControllerEnd(BusRates(described)).packet(packet)[0]
    message = database.get_message_by_frame_id(head.id)
    signals = message.decode(head.data.ljust(message.length, b"\0"), decode_choices=False)
    assert signals["segment"] == 0
    assert signals["packet_length"] == 1200
    assert signals["crc32"] == zlib.crc32(packet)


def test_cantools_reads_replies(described, database):
    modes = [4, 0, 4, 4, 0, 4]
    wire = Wire(described)
    received = words_of(wire.up(random_packet(np.random.default_rng(9), 11, mode=modes)), N)
    reply = CyclicPacket.zeros(12, N)
    reply.axes["mode"] = modes
    closed = np.array(modes) == 0
    reply.axes["d"][~closed, 0] = (np.arange(N) / 8)[~closed]
    reply.axes.view(np.int32).reshape(N, 9)[closed, 1:3] = received[closed, 1:3]
    signals = {}
    for each in decode_all(database, wire.near.reply(reply.encode())).values():
        signals |= each
    for k, mode in enumerate(modes, start=1):
        if described == "fd":
            assert signals["number"] == 12
            assert signals[f"mode_axis{k}"] == mode
            assert signals[f"mirrored_axis{k}"] == (mode == 0)
        else:
            assert signals["counter"] == 12
            assert signals[f"action_axis{k}"] == (mode == 4)
        if mode == 4:
            assert signals[f"D1_axis{k}"] == (k - 1) / 8
