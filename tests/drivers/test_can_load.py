"""Bus load: bits of a frame counted by hand, loads computed, loads measured on a bus log."""

from __future__ import annotations

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import CycleRing, Guard, Session, exchange
from drivers.transports.can.bus_load import (
    LOAD_LIMIT,
    BusRates,
    CanBusLoadError,
    classic_bits,
    fd_bits,
)
from drivers.transports.can.layout import SEGMENT_DOWN, SEGMENT_UP
from tests.drivers.can_bench import (
    Cycles,
    PacedByPackets,
    ns16_controller,
    ns16_train,
    virtual_ends,
    wide_limits,
)


def test_a_classic_frame_of_eight_bytes_has_111_bits_and_135_at_worst():
    assert classic_bits(8, stuffed=False) == (111, 0)
    assert classic_bits(8) == (135, 0)
    assert classic_bits(0, stuffed=False) == (47, 0)


def test_an_fd_frame_of_64_bytes_takes_140_microseconds_and_170_at_worst():
    rates = BusRates("fd")
    assert rates.duration(64, stuffed=False) == pytest.approx(139.8e-6)
    assert rates.duration(64) == pytest.approx(169.6e-6)
    assert rates.duration(48, stuffed=False) == pytest.approx(114.2e-6)
    assert rates.duration(48) == pytest.approx(137.6e-6)


def stuff_bits(bits):
    """Stuff bits that a transmitter inserts, as the standard says it."""
    count, run, last = 0, 0, None
    for bit in bits:
        run = run + 1 if bit == last else 1
        last = bit
        if run == 5:
            count, run, last = count + 1, 1, 1 - bit
    return count


@given(data=st.binary(min_size=8, max_size=8), seed=st.integers(0, 2**34 - 1))
def test_no_frame_is_stuffed_worse_than_the_worst_case(data, seed):
    """Whatever the 98 stuffable bits of an eight-byte frame are."""
    bits = [int(bit) for byte in data for bit in f"{byte:08b}"]
    bits += [seed >> i & 1 for i in range(34)]
    assert 111 + stuff_bits(bits) <= classic_bits(8).nominal


def test_the_worst_case_is_reached():
    bits = [0] * 5
    while len(bits) < 98:
        bits += [1 - bits[-1]] * 4
    assert 111 + stuff_bits(bits[:98]) == classic_bits(8).nominal


def test_six_axes_at_1_khz_take_less_than_half_of_an_fd_bus():
    assert BusRates("fd").load(6, 0.001) == pytest.approx(0.4768, abs=1e-4)
    assert BusRates("fd").load(6, 0.001) <= 0.50


def test_six_axes_fit_a_classic_bus_at_2_ms_and_not_at_1_ms():
    rates = BusRates("classic")
    assert rates.load(6, 0.002) == pytest.approx(0.675)
    rates.require_load(6, 0.002)
    with pytest.raises(CanBusLoadError, match=r"10 classic frames for 6 axes fill 135\.0 %") as e:
        rates.require_load(6, 0.001)
    assert "cycle of 1 ms; allowed is 70 %" in str(e.value)


@pytest.mark.parametrize(("n_axes", "fits"), [(1, True), (2, True), (3, False), (6, False)])
def test_at_1_ms_a_classic_bus_carries_two_axes(n_axes, fits):
    assert (BusRates("classic").load(n_axes, 0.001) <= LOAD_LIMIT) == fits


@given(
    n_axes=st.integers(1, 6),
    period=st.floats(5e-4, 1e-2),
    bitrate=st.sampled_from([125_000, 250_000, 500_000, 1_000_000]),
    profile=st.sampled_from(["fd", "classic"]),
)
def test_what_is_let_through_is_within_the_limit(n_axes, period, bitrate, profile):
    rates = BusRates(profile, bitrate)
    try:
        rates.require_load(n_axes, period)
    except CanBusLoadError:
        assert rates.load(n_axes, period) > LOAD_LIMIT
    else:
        assert rates.load(n_axes, period) <= LOAD_LIMIT


@pytest.mark.parametrize("size", [9, 65])
def test_frames_that_cannot_be_are_refused(size):
    with pytest.raises(ValueError, match=f"not {size}"):
        classic_bits(size)
    with pytest.raises(ValueError, match=f"not {size}"):
        fd_bits(size)


@pytest.mark.parametrize(("profile", "period"), [("fd", 0.001), ("classic", 0.002)])
def test_the_load_on_a_log_of_the_bus_is_the_computed_one(profile, period):
    """A third node logs a run; its frames, counted, take what was computed for a cycle."""
    clock = Cycles()
    near, far = virtual_ends(profile, clock)
    logger = can.Bus(near._port._bus.channel_id, "virtual")
    session = Session(ns16_train(), Guard(wide_limits(), period), CycleRing(6, 64))
    link = PacedByPackets(near, far, ns16_controller(period=period), clock=clock)
    exchange(link, session, until=lambda: link.cycle == 112)
    rates = BusRates(profile)
    busy = plain = 0.0
    while (message := logger.recv(0.0)) is not None:
        assert message.is_fd == (profile == "fd")
        if message.arbitration_id not in (SEGMENT_UP, SEGMENT_DOWN):
            busy += rates.duration(len(message.data))
            plain += rates.duration(len(message.data), stuffed=False)
    logger.shutdown()
    link.close()
    assert busy / (100 * period) == pytest.approx(rates.load(6, period))
    assert plain / (100 * period) == pytest.approx(rates.load(6, period, stuffed=False))
    assert busy / (100 * period) <= (0.50 if profile == "fd" else LOAD_LIMIT)
