"""A simulated controller in a process of its own, to be reached over loopback UDP in real time."""

from __future__ import annotations

import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from hil.cell import Cell
from hil.demo_link import LOOPBACK, SimulatorProcess, free_port

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
        """Start one for a cell; it is ended when this is left.

        Args:
            cell: has a table [simulation].
            folder: where its cell file is written.
            faults: lines as `hil simulate --fault` takes them.
            options: further options of `hil simulate`.
        """
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
        """End the session (the arm stands, the drive goes off, then mode 504).

        Returns:
            what it counted, see `docs/simulate.md`: cycles, replies, missed, late, intervals, …;
            nothing if it had to be killed.
        """
        if self._summary is None:
            self._simulator.finish()
            self._summary = self._simulator.end()
        return self._summary
