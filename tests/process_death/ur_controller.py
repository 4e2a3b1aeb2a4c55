"""A simulated UR controller in its own process, with an account of its cycles."""

from __future__ import annotations

import signal
from typing import Any, Final

from hil.cell import Cell
from hil.control.simulator_on_link import realtime_process
from hil.control.ur_simulation import simulated_ur
from sim_fixtures import Phase
from sim_fixtures.ur import SimulatedUr, UrServer
from sim_fixtures.ur.program import STREAMING, WAITING
from tests.process_death.page import WAIT, Life, Page, die_with_parent
from tests.process_death.rounds import Round

_ENDING: Final = 28
_ASKED: Final = (1, 2)
"""Endings of the program that the PC has asked for: an end, and a stop."""
_TOO_FAR: Final = 4
"""Ending of a program that refuses a set-point."""


def phase_of(robot: SimulatedUr) -> Phase:
    """Return the phase of C4G that the state of the program is like."""
    if robot.stream is None:
        return Phase.CLOSED
    if robot.stream.stage == WAITING:
        return Phase.OPENING
    if robot.stream.stage == STREAMING:
        return Phase.OPEN
    asked = robot.output_registers.ints.get(_ENDING) in _ASKED
    return Phase.CLOSING if asked else Phase.TRIPPED


class WaitingServer(UrServer):
    """A server whose cycles wait for the reply to each frame as long as the exchange lives."""

    def __init__(self, controller: SimulatedUr, cell: Cell, page: Page) -> None:
        table = cell.controller
        super().__init__(
            controller,
            table.host,
            rtde=table.rtde.port,
            primary=table.rtde.primary_port,
            dashboard=table.rtde.dashboard_port,
            cycle_extension=WAIT,
        )
        self._page = page
        self._life = Life()
        self._began = False
        self._sent_to: list[Any] = []
        self._step = controller.step
        controller.step = self._account  # type: ignore[method-assign]

    @property
    def replied(self) -> bool:
        """Whether the reply to the newest frame has come."""
        return any(client.written_in >= self.controller.cycle for client in self._asked)

    @property
    def _asked(self) -> list[Any]:
        """Clients that the newest frame was sent to, and that are to reply."""
        return [client for client in self._sent_to if client in self._clients]

    @property
    def deserted(self) -> bool:
        """Whether the exchange process has ended."""
        return self._began and not self._asked and self._life.over(self._page.exchange)

    @property
    def _waits(self) -> bool:
        if not self._began or self._page.abandoned:
            return False
        return not (self.replied if self._asked else self._life.over(self._page.exchange))

    def _account(self) -> None:
        """Run a cycle, and write down that before it as it ended."""
        robot = self.controller
        replied, deserted = self.replied, self.deserted
        number = robot._arriving[-1][1]["input_int_register_24"] if replied else 0
        began = self._began
        self._step()
        if began:
            too_far = robot.output_registers.ints.get(_ENDING) == _TOO_FAR
            plant = robot.arm.plant
            self._page.add((
                number, phase_of(robot), replied, deserted, too_far, plant.position,
                plant.velocity,
            ))  # fmt: skip
        # They are sent the frame of this cycle.
        self._sent_to = [client for client in self._clients if client.inputs and client.started]
        self._began = began or bool(self._sent_to)


def serve(cell: Cell, played: Round, page: Page) -> None:
    """Simulate the controller of a round until the parent ends, or on request."""
    die_with_parent(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    robot = simulated_ur(cell, seed=played.seed)
    server = WaitingServer(robot, cell, page)
    page.serving = 1
    with realtime_process(None):
        server.run(until=lambda: bool(page.abandoned))
    server.close()
