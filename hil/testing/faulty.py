"""Simulated cell with faults, in virtual time or over loopback UDP."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Final

from drivers.transports.simulated import SimulatedTransport
from hil.base.errors import HilError
from hil.base.exit_status import ExitStatus
from hil.base.progress import Silent
from hil.campaign import Campaign, VirtualLink, design
from hil.cell import Cell
from hil.control.simulated_cell import simulated_controller, simulated_link
from hil.control.simulator_process import LOOPBACK, SimulatorProcess, free_port
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
"""Values of `[campaign]`."""


def shortened(cell: Cell) -> Cell:
    """Return the cell with a campaign of seconds instead of minutes."""
    return cell.with_values({f"campaign.{key}": value for key, value in SHORT.items()})


def run_campaign(root: Path, cell: Cell) -> Campaign:
    """Design and run a campaign of a simulated cell in a new folder, in virtual time.

    The design takes a second; estimates from it are not accurate.

    Raises:
        CampaignFolderError: the folder is not empty.
        CellError: the cell is not simulated.
    """
    campaign = Campaign.create(root, cell, design(cell, Silent()))
    campaign.run(simulated_link(cell), durable=False, unrehearsed=True)
    return campaign


def faulty_controller(cell: Cell, *lines: str) -> SimulatedController:
    """Return a new simulated controller of a cell with a table [simulation].

    `lines` are faults as for `hil simulate --fault`; faults of the link are ignored.

    Raises:
        FaultScriptError: a line is not a fault.
    """
    _, controller_faults = split_faults(map(parse_fault, lines))
    return simulated_controller(cell, faults=controller_faults)


def faulty_link(
    cell: Cell, *lines: str, controller: SimulatedController | None = None
) -> VirtualLink:
    """Return a link in virtual time to a simulated controller, not yet connected.

    `controller` is by default `faulty_controller` of the same lines (FaultScriptError).
    """
    controller = controller or faulty_controller(cell, *lines)
    of_link, _ = split_faults(map(parse_fault, lines))
    return VirtualLink.over(SimulatedTransport(controller, of_link), cell, controller.finish)


REPLY_TIMEOUT: Final = 0.5
"""Time that the controller waits for a reply, s; longer than a real one, for slow computers."""


SESSION_SECONDS: Final = 120.0
"""Time after which the controller ends its session, s: a test's program moves for seconds."""


class SessionError(HilError):
    """The session of a simulated controller has no summary."""

    exit_code: ClassVar[int] = ExitStatus.CONTROLLER_FAULT


@dataclass(eq=False)
class UdpController:
    """`hil simulate` in a child process; repeats its first packet every second until a reply.

    Attributes:
        cell: with the link to it.
        cell_path: file of the cell.
        host: its address.
        port: UDP port on which the program under test must listen.
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
        """Start a controller with faults.

        Unless the options say otherwise, it ends its session (504) after `SESSION_SECONDS`: a
        program that stays until then must not wait for ever.

        Args:
            cell: of the controller.
            folder: of its cell file.
            faults: as of `hil simulate`.
            options: likewise.
        """
        port = free_port()
        path = folder / "udp_cell.toml"
        linked = cell.with_link(transport="udp", host=LOOPBACK, port=port, bind=LOOPBACK)
        own_cell = linked.with_urdf(path, "udp_robot.urdf")
        (folder / "udp_robot.urdf").write_text(own_cell.urdf, encoding="utf-8")
        path.write_text(own_cell.text, encoding="utf-8")
        given = [argument for fault in faults for argument in ("--fault", fault)]
        simulator = SimulatorProcess.start(
            path, "--udp", f"{LOOPBACK}:{port}", "--patience", str(REPLY_TIMEOUT),
            "--duration", str(SESSION_SECONDS), *given, *options,
        )  # fmt: skip
        controller = cls(own_cell, path, LOOPBACK, port, simulator)
        try:
            yield controller
        finally:
            controller._end()

    @property
    def running(self) -> bool:
        """Whether the process runs."""
        return self._simulator.running

    def press_drive_on(self) -> None:
        """Press the button that switches the drive on again."""
        self._simulator.process.send_signal(signal.SIGUSR1)

    def press_emergency_stop(self) -> None:
        """Press the emergency stop."""
        self._simulator.process.send_signal(signal.SIGUSR2)

    def finish(self) -> dict[str, Any]:
        """End the session: arm at rest, drive off, then mode 504.

        Returns its summary, see `docs/simulate.md`.

        Raises:
            SessionError: no reply of a PC program came, or the controller had to be killed.
        """
        summary = self._end()
        if not summary.get("cycles"):
            ended = "" if summary else "; it ended without a summary"
            raise SessionError(
                f"no reply came to the packets that the simulated controller sent to {self.host}:"
                f"{self.port}{ended}; check that the program under test listens on "
                "udp_controller.port, and start it before finish()"
            )
        return summary

    def _end(self) -> dict[str, Any]:
        """End the process; return its summary, {} if it had to be killed."""
        if self._summary is None:
            self._simulator.finish()
            self._summary = self._simulator.end()
        return self._summary
