"""The simulated cell of a test with faults that the test works out."""

from __future__ import annotations

from drivers.transports import SimulatedTransport
from hil.campaign import Link
from hil.cell import Cell
from hil.simulation import simulated_controller
from sim_fixtures import SimulatedController
from sim_fixtures.fault_script import parse_fault, split_faults


def faulty_controller(cell: Cell, *lines: str) -> SimulatedController:
    """A fresh simulated controller of a cell, with the faults that are its own.

    Args:
        cell: has a table [simulation].
        lines: what goes wrong, as `hil simulate --fault` takes it; faults of the link are read
            and left to the link.

    Raises:
        FaultScriptError: a line describes no fault.
    """
    _, own = split_faults(map(parse_fault, lines))
    return simulated_controller(cell, faults=own)


def faulty_link(cell: Cell, *lines: str, controller: SimulatedController | None = None) -> Link:
    """A link in virtual time to a simulated controller, not yet connected.

    Args:
        cell: has a table [simulation].
        lines: what goes wrong with link and controller.
        controller: `faulty_controller` of the same lines, where it is at hand.

    Raises:
        FaultScriptError: a line describes no fault.
    """
    controller = controller or faulty_controller(cell, *lines)
    of_link, _ = split_faults(map(parse_fault, lines))
    return Link.over(SimulatedTransport(controller, of_link), cell, controller.finish)
