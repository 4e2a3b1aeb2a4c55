"""The reader against a simulated controller, in virtual time: every frame, and every fault."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from drivers.errors import DriverError, TransportClosed
from drivers.transports.base import TransportError
from drivers.ur import reader as reader_module
from drivers.ur.identity import ArmIdentity, ask_identity
from drivers.ur.outputs import OPTIONAL
from drivers.ur.reader import RtdeReader
from drivers.ur.rtde import OutputsMissingError, RtdeError
from drivers.ur.transport import RtdeSpec
from sim_fixtures.ur import SimulatedUr, UrFault, UrServer, UrSettings

HOST = "127.0.0.1"


@contextmanager
def reading(
    *faults: UrFault, settings: UrSettings | None = None
) -> Iterator[tuple[RtdeReader, UrServer]]:
    """A reader of a simulated controller, started."""
    server = UrServer(SimulatedUr(settings, faults=faults), real_time=False)
    with server.running(), RtdeReader.connect(RtdeSpec(HOST, server.ports["rtde"])) as reader:
        reader.start()
        yield reader, server


def stamps_of(reader: RtdeReader, count: int) -> list[float]:
    """The time stamps of the next frames, or those that came before the connection ended."""
    stamps: list[float] = []
    try:
        while len(stamps) < count:
            stamps += reader.fetch(5.0).values["timestamp"].tolist()
    except TransportClosed:
        pass
    return stamps


def steps_of(stamps: list[float]) -> list[int]:
    return np.rint(np.diff(stamps) / 0.002).astype(int).tolist()


def test_every_frame_is_read() -> None:
    with reading() as (reader, server):
        assert str(reader.version) == "5.15.2.0"
        assert reader.frequency == 500.0
        stamps = stamps_of(reader, 3000)
        assert server.skipped == 0
    assert set(steps_of(stamps)) == {1}


def test_a_cb3_sends_a_quarter_as_often() -> None:
    with reading(settings=UrSettings(version=(3, 15, 8, 0))) as (reader, _):
        assert reader.frequency == 125.0
        assert set(steps_of(stamps_of(reader, 20))) == {4}


def test_frames_that_are_not_sent_are_missing() -> None:
    with reading(UrFault("gap", 100, 7), UrFault("gap", 300, 1)) as (reader, _):
        steps = steps_of(stamps_of(reader, 400))
    assert sorted(step for step in steps if step != 1) == [2, 8]


def test_frames_in_one_batch_and_text_between_them_are_all_read() -> None:
    with reading(UrFault("batch", 50, 40), UrFault("text", 120)) as (reader, _):
        texts: list[str] = []
        stamps: list[float] = []
        while len(stamps) < 300:
            frames = reader.fetch(5.0)
            stamps += frames.values["timestamp"].tolist()
            texts += [text.message for text in frames.texts]
    assert set(steps_of(stamps)) == {1}
    assert texts == ["a line of text in between"]


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("disconnect", "the controller closed the connection$"),
        ("truncate", "closed the connection within a frame, 32[0-9] bytes of which came"),
        ("silence", "the controller was silent for 0.3 s"),
    ],
)
def test_all_frames_before_the_end_are_read(
    kind: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reader_module, "SILENCE_TIMEOUT", 0.3)
    with reading(UrFault(kind, 250)) as (reader, _):
        assert len(stamps_of(reader, 10_000)) == 250
        with pytest.raises(TransportClosed, match=reason):
            reader.fetch(1.0)


def test_outputs_that_a_version_lacks_are_left_out() -> None:
    settings = UrSettings(without=OPTIONAL)
    with reading(settings=settings) as (reader, _):
        assert reader.absent == OPTIONAL
        assert reader.fetch(5.0).values.dtype.names[0] == "timestamp"


def test_outputs_that_are_required_are_not() -> None:
    with (
        pytest.raises(OutputsMissingError, match="target_moment"),
        reading(settings=UrSettings(without=("target_moment", "payload"))),
    ):
        pass


def test_a_port_where_nobody_listens_names_the_remedy() -> None:
    with socket.create_server((HOST, 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(TransportError, match="RTDE is enabled at the controller"):
        RtdeReader.connect(RtdeSpec(HOST, port))


@pytest.mark.long
def test_another_server_is_no_controller() -> None:
    with UrServer(SimulatedUr()).running() as server, pytest.raises(DriverError, match="RTDE"):
        RtdeReader.connect(RtdeSpec(HOST, server.ports["dashboard"]))


def test_an_old_controller_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reader_module.rtde, "VERSION", 2)
    with UrServer(SimulatedUr()).running() as server:
        monkeypatch.setattr(reader_module.rtde, "version_request", lambda: b"\0\5V\0\3")
        with pytest.raises(RtdeError, match="does not have version 2"):
            RtdeReader.connect(RtdeSpec(HOST, server.ports["rtde"]))


def test_a_link_to_this_computer_is_local() -> None:
    assert RtdeSpec(HOST).is_local and not RtdeSpec("192.0.2.1").is_local


def test_an_arm_says_who_it_is() -> None:
    with UrServer(SimulatedUr()).running() as server:
        identity = ask_identity(
            HOST, primary=server.ports["primary"], dashboard=server.ports["dashboard"]
        )
    assert identity.unreachable == ()
    assert (identity.named(5), identity.named(3)) == ("UR5e", "UR5")
    assert identity.serial_number == "20235500123"
    assert identity.remote_control is False
    assert identity.calibration == "1f2e3d4c5b6a798897a6b5c4d3e2f1000f1e2d3c4b5a6978"
    assert identity.calibrated.a.tolist() == [0.0, -0.425, -0.3922, 0.0, 0.0, 0.0]
    assert identity.calibrated.d.tolist() == [0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996]
    np.testing.assert_allclose(np.degrees(identity.upper), [360, 360, 180, 360, 360, 360])
    np.testing.assert_allclose(np.degrees(identity.velocity), 180.0)
    np.testing.assert_allclose(identity.acceleration, 40.0)


@pytest.mark.parametrize(
    ("model", "name"), [("UR5", "UR5e"), ("UR5e", "UR5e"), ("UR20", "UR20"), ("other", "other")]
)
def test_a_type_that_only_the_dashboard_states_has_its_full_name(model: str, name: str) -> None:
    """It leaves out the e of the e-Series."""
    assert ArmIdentity(model=model).named(5) == name
    assert ArmIdentity(model="UR5").named(3) == "UR5"


def test_what_cannot_be_asked_is_stated() -> None:
    with socket.create_server((HOST, 0)) as listener:
        closed = listener.getsockname()[1]
    identity = ask_identity(HOST, primary=closed, dashboard=closed)
    assert identity.serial_number is None
    assert [text.partition(" (")[0] for text in identity.unreachable] == [
        "primary interface", "dashboard server"
    ]  # fmt: skip
