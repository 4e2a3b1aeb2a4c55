"""Session and simulated controller of a UR5e in virtual time, with their faults."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from drivers.cycle_records import CycleRing
from drivers.events import Event, MotionEnded, MotionStarted
from drivers.exchange.loop import exchange
from drivers.guard import Guard
from drivers.session import Session
from drivers.states import State
from drivers.transports.simulated import Fault, SimulatedTransport
from drivers.wire import state_of
from hil.cell import Cell
from hil.control.motions import player_of
from hil.control.move import plan_move
from hil.control.ur_simulation import UrPeer, simulated_ur
from planner import TrajectoryPlayer
from sim_fixtures.ur import CELL_PATH, SimulatedUr
from sim_fixtures.ur.controller import parse_ur_fault

PERIOD = 0.002
MIDST = 260
"""A cycle within a motion that was requested at the beginning, at speed."""


@cache
def ur_cell() -> Cell:
    return Cell.load(CELL_PATH).with_values({"controller.transport": "simulated"})


class UrBench:
    """One session: `move` requests a motion, `run` lets cycles pass."""

    def __init__(
        self,
        *faults: str,
        cell: Cell | None = None,
        link: Sequence[Fault] = (),
        **settings: object,
    ) -> None:
        self.cell = cell or ur_cell()
        robot = simulated_ur(self.cell, faults=[parse_ur_fault(text) for text in faults])
        robot.settings = replace(robot.settings, **settings)  # type: ignore[arg-type]
        robot.slider = robot.settings.slider
        self.robot: SimulatedUr = robot
        self.peer = UrPeer(robot)
        self.transport = SimulatedTransport(self.peer, link)
        settings_of_session = self.cell.session_settings()
        self.ring = CycleRing(6, capacity=8192, state=state_of(settings_of_session))
        self.session = Session(
            self.cell.drive_train,
            Guard(self.cell.guard_limits, self.cell.period),
            self.ring,
            **settings_of_session,
        )
        self.events: list[Event] = []
        self.positions: list[np.ndarray] = []
        self.stages: list[int] = []
        self.silent_from: int | None = None
        send = self.transport.send

        def sends(packet: bytes) -> None:
            if self.silent_from is None or robot.cycle < self.silent_from:
                send(packet)

        self.transport.send = sends  # type: ignore[method-assign]
        step = robot.step

        def steps() -> None:
            step()
            self.positions.append(robot.arm.plant.position.copy())
            self.stages.append(robot.output_registers.ints.get(25, 0))

        robot.step = steps  # type: ignore[method-assign]

    def player(self, by: float = 20.0, speed: float = 0.5, joint: int = 0) -> TrajectoryPlayer:
        target = self.cell.initial.copy()
        target[joint] += np.radians(by)
        planned = plan_move(self.cell, self.cell.initial, target, speed=speed)
        return player_of(self.cell, planned.motion.trajectory)

    def move(self, **motion: float) -> UrBench:
        """Request a motion of joint 1 and run it to its end, or for 4000 cycles."""
        self.run(3)
        self.session.request(self.player(**motion))  # type: ignore[arg-type]
        return self.run(4000, until=lambda: not self.session.requested)

    def run(self, cycles: int, until=lambda: False) -> UrBench:
        end = self.transport.cycle + cycles

        def finished() -> bool:
            self.events += self.session.events()
            return self.transport.cycle >= end or until()

        exchange(self.transport, self.session, ends_when=finished)
        self.events += self.session.events()
        return self

    @property
    def ended(self) -> MotionEnded:
        (ended,) = [event for event in self.events if isinstance(event, MotionEnded)]
        return ended

    @property
    def started(self) -> bool:
        return any(isinstance(event, MotionStarted) for event in self.events)

    @property
    def state(self) -> State:
        return self.session.state

    @property
    def rests(self) -> bool:
        """Whether the arm has been at rest for the last 50 cycles."""
        return bool(np.ptp(np.array(self.positions[-50:]), axis=0).max() < 2e-4)

    def travel(self, since: int) -> float:
        """Largest distance of a joint, from a cycle on, from where it was then [rad]."""
        track = np.array(self.positions[since:])
        return float(np.abs(track - track[0]).max())
