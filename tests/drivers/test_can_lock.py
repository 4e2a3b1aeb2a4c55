"""One program to a CAN bus."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import pytest

from drivers.transports.base import TransportError
from drivers.transports.can.transport import BusLock


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))


def test_a_bus_that_another_program_has_is_refused_with_its_number() -> None:
    first = BusLock("socketcan", "can0")
    with pytest.raises(TransportError, match=rf"another program has it \(process {os.getpid()}\)"):
        BusLock("socketcan", "can0")
    BusLock("socketcan", "can1").release()
    first.release()
    first.release()
    BusLock("socketcan", "can0").release()


def test_two_names_of_one_serial_port_are_one_bus(tmp_path: Path) -> None:
    port, name = tmp_path / "ttyACM0", tmp_path / "by-id"
    port.touch()
    name.symlink_to(port)
    held = BusLock("slcan", str(port))
    with pytest.raises(TransportError, match="another program has it"):
        BusLock("slcan", str(name))
    held.release()


def test_a_bus_within_one_process_needs_none(tmp_path: Path) -> None:
    BusLock("virtual", "0")
    BusLock("virtual", "0")
    assert not list(tmp_path.iterdir())


def test_a_lock_that_is_a_link_to_elsewhere_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "hil-can-socketcan_can0.lock").symlink_to(tmp_path / "victim")
    with pytest.raises(TransportError, match="cannot be opened"):
        BusLock("socketcan", "can0")
    assert not (tmp_path / "victim").exists()
