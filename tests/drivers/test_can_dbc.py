"""The shipped DBC files say what our frames say, in both directions, read by cantools."""

from __future__ import annotations

from pathlib import Path

import cantools
import numpy as np
import pytest

from drivers.packets import CyclicPacket, Mode
from drivers.transports.can import ends
from drivers.transports.can.bus_load import BusRates
from drivers.transports.can.codecs import words_of
from drivers.transports.can.ends import ControllerEnd
from drivers.transports.can.layout import (
    CLASSIC_MODE_CODES,
    FD_MODE_CODES,
    SEGMENT_UP,
    Frame,
)
from tests.drivers.can_bench import PROFILES, N, Wire, decoded, init_packet, random_packet

CODES = {"fd": FD_MODE_CODES, "classic": CLASSIC_MODE_CODES}
AXES = range(1, N + 1)
FOLDER = Path(ends.__file__).parent
SLOW_FIELDS = ("D2", "extra1", "extra2", "extra3")


@pytest.fixture(scope="module", params=PROFILES)
def profile(request):
    return request.param


@pytest.fixture(scope="module")
def database(profile):
    return cantools.database.load_file(FOLDER / f"c4g_open_{profile}.dbc", strict=True)


def test_every_frame_that_we_send_is_described_with_its_kind_and_length(profile, database):
    wire = Wire(profile)
    frames = wire.far.packet(init_packet())[:2]
    frames += wire.far.packet(random_packet(np.random.default_rng(1), 11))
    wire.up(random_packet(np.random.default_rng(1), 12))
    frames += wire.near.drive_off()
    for frame in frames:
        message = database.get_message_by_frame_id(frame.id)
        assert message.is_fd == (profile == "fd")
        assert not message.is_extended_frame
        assert message.length == len(frame.data) or frame.id == SEGMENT_UP


def decode_all(database, frames):
    """Signals by frame name."""
    return {
        database.get_message_by_frame_id(frame.id).name: database.decode_message(
            frame.id, frame.data, decode_choices=False
        )
        for frame in frames
    }


def as_bits(values):
    return np.array(values, np.float32).view(np.int32)


def test_cantools_reads_what_the_controller_sends(profile, database):
    end = ControllerEnd(BusRates(profile))
    end.packet(init_packet())
    seen = set()
    for number in range(11, 36):
        packet = random_packet(np.random.default_rng(number), number)
        signals = decode_all(database, end.packet(packet))
        wanted = decoded(packet)
        check_up(profile, signals, wanted)
        seen |= check_slow(signals["UP_B" if profile == "fd" else "UP_HEADER"], wanted)
    assert len(seen) == 25, "each slow value had its turn"


def check_up(profile, signals, wanted):
    modes = [CODES[profile][mode] for mode in wanted.axes["mode"].tolist()]
    d = wanted.axes["d"]
    if profile == "fd":
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


def test_we_read_what_cantools_makes_of_the_controllers_side(profile, database):
    wire = Wire(profile)
    rng = np.random.default_rng(8)
    targets, positions = rng.integers(-9999, 9999, (2, N)) / 2**16
    currents = rng.integers(-999, 999, N) / 64
    if profile == "fd":
        messages = fd_up(targets, positions, currents)
    else:
        messages = classic_up(targets, positions, currents)
    frames = [
        Frame(database.get_message_by_name(name).frame_id, database.encode_message(name, signals))
        for name, signals in messages.items()
    ]
    got = decoded(wire.take(frames))
    assert got.number == 77
    assert got.status == bytes((5, 0, 0, 0))
    assert (got.axes["mode"] == 4).all()
    np.testing.assert_array_equal(got.axes["d"][:, 0], targets)
    np.testing.assert_array_equal(got.axes["d"][:, 2], positions)
    np.testing.assert_array_equal(got.axes["d"][:, 4], currents)
    assert got.axes["extra"][3, 1] == 0.125
    assert wire.near.ages[3, 6] == 0


SLOW_VALUE = {"slow": 6 * 2 + 3, "extra2_axis4": 0.125}


def fd_up(targets, positions, currents):
    a = {"number": 77} | {f"mode_axis{k}": 4 for k in AXES}
    a |= {f"D1_axis{k}": targets[k - 1] for k in AXES}
    a |= {f"D3_axis{k}": positions[k - 1] for k in AXES}
    a |= {f"D4_axis{k}": 0.0 for k in (1, 2)}
    b = {"number": 77, "status": 5, **SLOW_VALUE}
    b |= {f"D4_axis{k}": 0.0 for k in (3, 4, 5, 6)}
    b |= {f"D5_axis{k}": currents[k - 1] for k in AXES}
    return {"UP_A": a, "UP_B": b}


def classic_up(targets, positions, currents):
    header = {"number": 77, "status": 5, **SLOW_VALUE}
    axes = {
        f"UP_AXIS_{k}": {
            "counter": 77 % 16,
            "mode": CODES["classic"][4],
            "D3": positions[k - 1],
            "D1_minus_D3": targets[k - 1] - positions[k - 1],
            "D5": currents[k - 1],
        }
        for k in AXES
    }
    return {"UP_HEADER": header, **axes}


def answered(wire, modes):
    """Frames of an answer that sets some axes and mirrors others, and its packet."""
    sent = random_packet(np.random.default_rng(9), 11, mode=modes)
    seen = words_of(wire.up(sent), N)
    reply = CyclicPacket.zeros(12, N)
    reply.axes["mode"] = modes
    closed = np.array(modes) == 0
    reply.axes["d"][~closed, 0] = (np.arange(N) / 8)[~closed]
    words = reply.axes.view(np.int32).reshape(N, 9)
    words[closed, 1:3] = seen[closed, 1:3]
    return wire.near.reply(reply.encode()), reply


def test_cantools_reads_what_the_pc_answers(profile, database):
    modes = [4, 0, 4, 4, 0, 4]
    frames, _ = answered(Wire(profile), modes)
    signals = {}
    for each in decode_all(database, frames).values():
        signals |= each
    for k, mode in enumerate(modes, start=1):
        if profile == "fd":
            assert signals["number"] == 12
            assert signals[f"mode_axis{k}"] == mode
            assert signals[f"mirrored_axis{k}"] == (mode == 0)
        else:
            assert signals["counter"] == 12
            assert signals[f"action_axis{k}"] == (mode == 4)
        if mode == 4:
            assert signals[f"D1_axis{k}"] == (k - 1) / 8


def test_we_read_what_cantools_makes_of_the_pcs_side(profile, database):
    wire = Wire(profile)
    wire.up(random_packet(np.random.default_rng(9), 11))
    if profile == "fd":
        signals = {"number": 12, "status": 1}
        for k in AXES:
            signals |= {f"mode_axis{k}": 4, f"mirrored_axis{k}": 0}
            signals |= {f"D1_axis{k}": k / 4, f"D2_axis{k}": k / 512}
        messages = {"DOWN": signals}
    else:
        messages = {}
        for pair in (1, 2, 3):
            first, second = 2 * pair - 1, 2 * pair
            messages[f"DOWN_{pair}"] = {
                "counter": 12,
                f"action_axis{first}": 2,
                f"D1_axis{first}": first / 4,
                f"action_axis{second}": 2,
                f"D1_axis{second}": second / 4,
            }
    reply = None
    for name, values in messages.items():
        frame_id = database.get_message_by_name(name).frame_id
        reply = wire.far.receive(Frame(frame_id, database.encode_message(name, values)), wire.time)
    got = decoded(reply)
    assert got.number == 12
    assert got.status == bytes((1, 0, 0, 0))
    np.testing.assert_array_equal(got.axes["d"][:, 0], np.arange(1, 7) / 4)
    if profile == "fd":
        np.testing.assert_array_equal(got.axes["d"][:, 1], np.arange(1, 7) / 512)


def test_mode_codes_have_the_names_of_the_modes(profile, database):
    name = "UP_A" if profile == "fd" else "UP_AXIS_1"
    signal = next(
        s for s in database.get_message_by_name(name).signals if s.name in ("mode", "mode_axis1")
    )
    choices = {code: str(choice) for code, choice in signal.choices.items()}
    known = {int(mode): mode.name.lower() for mode in Mode}
    names = {code: known.get(mode, f"mode_{mode}") for mode, code in CODES[profile].items()}
    assert choices == names


def test_the_head_of_a_segmented_packet_can_be_read(profile, database):
    import zlib

    packet = init_packet()
    head = ControllerEnd(BusRates(profile)).packet(packet)[0]
    message = database.get_message_by_frame_id(head.id)
    signals = message.decode(head.data.ljust(message.length, b"\0"), decode_choices=False)
    assert signals["segment"] == 0
    assert signals["packet_length"] == 1200
    assert signals["crc32"] == zlib.crc32(packet)
