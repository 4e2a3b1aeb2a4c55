"""The simulated cell of a test with faults that the test works out, here or over loopback UDP."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from drivers.transports.simulated import SimulatedTransport
from hil.campaign import Campaign, Link, design
from hil.cell import Cell
from hil.demo_link import LOOPBACK, SimulatorProcess, free_port
from hil.progress import Silent
from hil.simulation import simulated_controller, simulated_link
from sim_fixtures import SimulatedController
from sim_fixtures.faults import parse_fault, split_faults

SHORT: Final = {
    "repetitions": 2,
    "validation_runs": 1,
    "n_via": 3,
    "candidates": 10,
    "approach_speed": 1.0,
    "standstill_s": 0.5,
    "settle_s": 0.2,
    "warmup_drift": 0,
}
"""Of `[campaign]`."""


def shortened(cell: Cell) -> Cell:
    """The cell with a campaign of seconds instead of minutes, in its text too."""
    return cell.with_values({f"campaign.{key}": value for key, value in SHORT.items()})


def run_campaign(root: Path, cell: Cell) -> Campaign:
    """Design and run a campaign of a simulated cell in a new folder, in virtual time.

    Its motion is found in a second: no estimate from it is one to rely on.

    Raises:
        CampaignFolderError: the folder holds something already.
        CellError: the cell is not a simulated one.
    """
    campaign = Campaign.create(root, cell, design(cell, Silent()))
    campaign.run(simulated_link(cell), durable=False, unrehearsed=True)
    return campaign


def faulty_controller(cell: Cell, *lines: str) -> SimulatedController:
    """A fresh simulated controller of a cell with a table [simulation], with faults of its own.

    `lines` say what goes wrong as `hil simulate --fault` takes it; faults of the link are ignored.

    Raises:
        FaultScriptError: a line describes no fault.
    """
    _, own = split_faults(map(parse_fault, lines))
    return simulated_controller(cell, faults=own)


def faulty_link(cell: Cell, *lines: str, controller: SimulatedController | None = None) -> Link:
    """A link in virtual time to a simulated controller, not yet connected.

    `controller` is `faulty_controller` of the same lines, where it is at hand.

    Raises:
        FaultScriptError: a line describes no fault.
    """
    controller = controller or faulty_controller(cell, *lines)
    of_link, _ = split_faults(map(parse_fault, lines))
    return Link.over(SimulatedTransport(controller, of_link), cell, controller.finish)


PATIENCE: Final = 0.5
"""s that the controller waits for an answer, as no real one does: a computer that runs tests need
not be fit for a robot."""


@dataclass(eq=False)
class UdpController:
    """`hil simulate`, running; it sends its first packet again every second until it is answered.

    Attributes:
        cell: of its arm, with the link by which it is reached.
        cell_path: the same as a file.
        host: its address.
        port: the UDP port on which the program under test has to listen.
    """

    cell: Cell
    cell_path: Path
    host: str
    port: int
    _simulator: SimulatorProcess = field(repr=False)
    _summary: dict[str, Any] | None = field(default=None, repr=False)

    @classmethod
    @contextmanager
    def started(
        cls,
        cell: Cell,
        folder: Path,
        *,
        faults: Sequence[str] = (),
        options: Sequence[str] = (),
    ) -> Iterator[UdpController]:
        """Start one, its cell file in `folder`, with faults and options of `hil simulate`."""
        port = free_port()
        path = folder / "udp_cell.toml"
        linked = cell.with_link(transport="udp", host=LOOPBACK, port=port, bind=LOOPBACK)
        own = linked.with_urdf(path, "udp_robot.urdf")
        (folder / "udp_robot.urdf").write_text(own.urdf, encoding="utf-8")
        path.write_text(own.text, encoding="utf-8")
        given = [argument for fault in faults for argument in ("--fault", fault)]
        simulator = SimulatorProcess.start(
            path, "--udp", f"{LOOPBACK}:{port}", "--patience", str(PATIENCE), *given, *options
        )
        controller = cls(own, path, LOOPBACK, port, simulator)
        try:
            yield controller
        finally:
            controller.finish()

    @property
    def running(self) -> bool:
        """Whether its session goes on, or has yet to begin."""
        return self._simulator.running

    def press_drive_on(self) -> None:
        """Press the button that switches the drive on again."""
        self._simulator.process.send_signal(signal.SIGUSR1)

    def press_emergency_stop(self) -> None:
        """Press the emergency stop."""
        self._simulator.process.send_signal(signal.SIGUSR2)

    def finish(self) -> dict[str, Any]:
        """End the session: the arm stands, the drive goes off, then mode 504.

        Returns:
            what it counted, see `docs/simulate.md`; nothing if it had to be killed.
        """
        if self._summary is None:
            self._simulator.finish()
            self._summary = self._simulator.end()
        return self._summary
