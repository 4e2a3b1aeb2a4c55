"""Packets that got no answer, or never reached the session."""

from __future__ import annotations

import pytest

from drivers import LinkLost, PacketRejected
from tests.drivers.rig import Rig, still


def test_what_the_link_discarded_is_counted_and_told_once():
    rig = Rig()
    rig.session.discarded("foreign", 3)
    rig.session.discarded("torn", 1)
    rig.session.discarded("foreign", 2)
    assert rig.session.counters.discarded == {"foreign": 5, "torn": 1}
    assert rig.session.events() == [PacketRejected("foreign", 5), PacketRejected("torn", 1)]
    assert rig.session.events() == []
    rig.session.discarded("foreign", 1)
    assert rig.session.events() == [PacketRejected("foreign", 1)]
    assert rig.session.counters.discarded == {"foreign": 6, "torn": 1}


@pytest.mark.parametrize("count", [0, -1])
def test_nothing_discarded_is_not_told(count):
    rig = Rig()
    rig.session.discarded("foreign", count)
    assert rig.session.counters.discarded == {}
    assert rig.session.events() == []


def test_sessions_do_not_share_their_counts():
    one, other = Rig(), Rig()
    one.session.discarded("torn", 1)
    assert other.session.counters.discarded == {}


def test_it_is_told_together_with_what_the_session_rejected():
    rig = Rig()
    rig.close()
    rig.session.events()
    rig.send(b"short")
    rig.send(rig.transcript[0][0][:100])
    rig.session.discarded("malformed", 3)
    assert rig.session.counters.malformed == 2
    assert [event for event in rig.events + rig.session.events()
            if isinstance(event, PacketRejected)] == [
        PacketRejected("malformed", 1), PacketRejected("malformed", 1),
        PacketRejected("malformed", 3),
    ]  # fmt: skip


class TestReasons:
    """What arrived and was not understood says why it got no answer."""

    def test_a_packet_that_is_none(self):
        rig = Rig()
        for _ in range(40):
            rig.send(bytes(12))
        whys = {event.why for event in rig.seen(PacketRejected)}
        assert whys == {"12 bytes: packet number is 0; expected 1..32767"}

    def test_a_packet_of_a_session_that_began_before(self):
        rig = Rig()
        rig.number = 500
        rig.cycle()
        assert "no drive on before init" in rig.seen(PacketRejected)[-1].why

    def test_packets_that_do_not_follow_are_not_silence(self):
        rig = Rig()
        rig.session.request(still(3))
        rig.close()
        for _ in range(30):
            rig.number = 3
            assert rig.cycle() is None
        rig.session.tick(rig.now + 2.0)
        rig.events += rig.session.events()
        assert [event.stale for event in rig.seen(LinkLost)] == [30]
        assert rig.ended.reason == "only packets that do not follow the last one came (30)"
        assert rig.seen(PacketRejected)[-1].why.endswith("does not follow 11")
