"""The table of links: what cell file, doctor, screen and `hil simulate` read of each transport."""

from __future__ import annotations

import pickle
from dataclasses import dataclass, replace
from typing import Any, get_args

import pytest

from drivers import Transport
from drivers.transports.base import TransportSpec
from hil.base.errors import InputError
from hil.cell import Cell
from hil.cell.schema import LINKS, CanTable, ControllerTable
from hil.control.simulated_cell import controller_settings
from hil.control.simulator_on_link import open_controller_link
from hil.doctor.checks import System, link_checks
from hil.doctor.findings import CheckStatus, DoctorCheck, UncheckedLink
from sim_fixtures.ns16 import CELL_PATH

CELL = Cell.load(CELL_PATH).with_link(cycle_ms=2)
BUS = CanTable(interface="virtual", channel="links")
HERE: dict[str, dict[str, Any]] = {"udp": {"host": "127.0.0.1"}, "can": {"can": BUS}}
AWAY: dict[str, dict[str, Any]] = {
    "udp": {"host": "192.0.2.1"},
    "can": {"can": CanTable(interface="socketcan", channel="can0")},
}
ADDRESSES = {"udp": "127.0.0.1:2001", "can": "virtual:links:fd"}


@dataclass(frozen=True)
class Unjudged(TransportSpec):
    """A transport that states nothing but how it is opened."""

    def open(self) -> Transport:
        pytest.fail("it is not opened by what only describes a link")


class TestLinks:
    def test_every_transport_has_a_row(self) -> None:
        names = get_args(ControllerTable.model_fields["transport"].annotation)
        assert {*names} == {"simulated", *LINKS} == {"simulated", *HERE, "rtde"}

    def test_an_arm_of_universal_robots_is_reached_by_its_own_ports(self) -> None:
        here, away = (
            CELL.with_link(transport="rtde", host=host) for host in ("127.0.0.1", "192.0.2.1")
        )
        assert here.only_simulated and not away.only_simulated
        spec = away.transport_spec()
        assert pickle.loads(pickle.dumps(spec)) == spec
        settings = away.session_settings()
        assert settings["max_gap"] == settings["protocol"].program.patience - 1 == 4

    @pytest.mark.parametrize("name", HERE)
    def test_a_row_serves_cell_doctor_and_controller(self, name: str) -> None:
        """The settings reach the exchange process, and only a link on this computer is local."""
        here, away = (CELL.with_link(transport=name, **each[name]) for each in (HERE, AWAY))
        assert here.only_simulated and not away.only_simulated
        spec = away.transport_spec()
        assert pickle.loads(pickle.dumps(spec)) == spec
        assert len(link_checks(spec, System())) == len(spec.needs) > 0
        settings = replace(controller_settings(CELL), period=0.002)
        open_controller_link({"--link": f"{name}:{ADDRESSES[name]}"}, settings, 6).close()

    def test_without_a_local_rule_it_is_real(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """A loopback address says nothing of a transport that does not judge it."""
        link = replace(LINKS["udp"], spec=lambda *_: Unjudged())  # type: ignore[arg-type]
        monkeypatch.setitem(LINKS, "udp", link)
        cell = CELL.with_link(transport="udp", host="127.0.0.1")
        assert not cell.only_simulated
        unknown = DoctorCheck(CheckStatus.UNKNOWN, UncheckedLink("the controller"))
        assert link_checks(cell.link_spec, System()) == [unknown]

    @pytest.mark.parametrize(
        "link", ["no-such:127.0.0.1:1", "", "udp:127.0.0.1", "can:x", "rtde:127.0.0.1"]
    )
    def test_a_wrong_link_is_refused(self, link: str) -> None:
        with pytest.raises(InputError, match=r"--link .* write"):
            open_controller_link({"--link": link}, controller_settings(CELL), 6)
