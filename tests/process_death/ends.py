"""The two links whose processes are killed: cell, controller, and how a campaign is completed."""

from __future__ import annotations

import errno
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket
from typing import Any, Final

import numpy as np

from drivers.transports.simulated import SimulatedTransport
from hil.campaign import Campaign, CampaignPlan
from hil.cell import Cell
from hil.control.simulated_cell import simulated_controller
from hil.control.simulator_process import LOOPBACK, free_port
from hil.control.ur_simulation import UrPeer, simulated_ur
from hil.control.virtual_link import VirtualLink
from sim_fixtures.ur import CELL_PATH
from tests.hil.fast_cell import fast_cell
from tests.hil.loopback import on_loopback
from tests.process_death import controller, ur_controller
from tests.process_death.page import Page
from tests.process_death.rounds import LinkName, Round

NOISE: Final = 0.004
"""A, of the simulated currents. With the cell's own the arm trembles at rest about as fast as what
still counts as standstill, and some runs are refused for it without anybody having died."""
SHORT: Final[dict[str, Any]] = {
    "repetitions": 2,
    "validation_runs": 1,
    "n_via": 2,
    "standstill_s": 0.1,
    "settle_s": 0.15,
    "candidates": 6,
}  # Of the cell's `[campaign]`: a campaign of four seconds


@dataclass(frozen=True)
class LinkEnds:
    """One link.

    Attributes:
        joints: of its arm.
        cell: in a folder, of an arm whose campaign takes seconds.
        on_free_ports: that cell with ports of this computer.
        serve: the controller of a round, until the parent ends or on request.
        in_virtual_time: a link to such a controller with a seed, arm at home.
        port_in_use: whether something listens at the port that this PC opens for the cell.
    """

    joints: int
    cell: Callable[[Path], Cell]
    on_free_ports: Callable[[Cell], Cell]
    serve: Callable[[Cell, Round, Page], None]
    in_virtual_time: Callable[[Cell, int], VirtualLink]
    port_in_use: Callable[[Cell], bool]

    def made(self, folder: Path, cell: Cell, plan: CampaignPlan) -> Campaign:
        """Return a campaign in a new folder, on ports of the loopback device that are free."""
        return Campaign.create(folder / "campaign", self.on_free_ports(cell), plan)


def _c4g_cell(folder: Path) -> Cell:
    return fast_cell(folder, **SHORT).with_values({"simulation.current_noise": NOISE})


def _c4g_link(cell: Cell, seed: int) -> VirtualLink:
    at_home = cell.with_values({"simulation.initial_deg": cell.campaign.home_deg})
    simulated = simulated_controller(at_home, seed=seed)
    return VirtualLink.over(SimulatedTransport(simulated), cell, finish=simulated.finish)


def _ur_cell(_: Path) -> Cell:
    """Return the cell of the simulated UR5e, whose arm begins at home."""
    values = {f"campaign.{name}": value for name, value in SHORT.items()}
    values |= {"campaign.warmup_drift": 0, "campaign.approach_speed": 0.5}
    return Cell.load(CELL_PATH).with_values(values | {"simulation.current_noise": NOISE})


def _on_free_ports(cell: Cell) -> Cell:
    names = ("port", "primary_port", "dashboard_port")
    return cell.with_values({f"controller.rtde.{name}": free_port() for name in names})


def _ur_link(cell: Cell, seed: int) -> VirtualLink:
    assert np.array_equal(cell.initial, cell.home)
    peer = UrPeer(simulated_ur(cell, seed=seed))
    return VirtualLink.over(SimulatedTransport(peer), cell, finish=peer.finish)


def _c4g_port_in_use(cell: Cell) -> bool:
    with socket(AF_INET, SOCK_DGRAM) as probe:
        try:
            probe.bind((LOOPBACK, cell.controller.port or 0))
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            return True
    return False


def _ur_port_in_use(_: Cell) -> bool:
    """Return False: this PC opens no port for a UR."""
    return False


ENDS: Final[Mapping[LinkName, LinkEnds]] = {
    "udp": LinkEnds(2, _c4g_cell, on_loopback, controller.serve, _c4g_link, _c4g_port_in_use),
    "rtde": LinkEnds(6, _ur_cell, _on_free_ports, ur_controller.serve, _ur_link, _ur_port_in_use),
}
