"""Every fault in every situation of a session with a UR controller, judged as it is with others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any, Final

import numpy as np

from drivers import CycleRing, Guard, Session, State
from drivers.c4g_packets import Mode
from drivers.wire import state_of
from hil.cell import Cell
from hil.control.motions import player_of
from hil.control.move import plan_move
from hil.control.ur_simulation import UrPeer, simulated_ur
from planner import TrajectoryPlayer
from planner.arrays import Array
from sim_fixtures.faults import split_faults
from sim_fixtures.ur import CELL_PATH, UrFault
from sim_fixtures.ur.controller import parse_ur_fault
from tests.drivers.ur.ur_judge import JudgedUrSession, UrConduct
from tests.fault_matrix import faulty_runs
from tests.fault_matrix.faulty_runs import SILENCE, Run
from tests.faults import kind_of, parse_script

_OF_LINK: Final = (
    "packet lost", "3 packets lost", "5 packets lost", "link dead for 0.2 s", "reply lost",
    "3 replies lost", "5 replies lost", "packet late", "packet past its cycle", "reply late",
    "packet doubled", "reply doubled",
)  # fmt: skip
"""Faults of any link; those that TCP excludes are not among them."""
FAULTS: Final[Mapping[str, str]] = {
    **{name: faulty_runs.FAULTS[name] for name in _OF_LINK},
    "link dead for 0.2 s": "lose@{c}x100",
    "half a frame of inputs": "corrupt@{c}:offset=20:mask=0x01:to_controller",
    "another number in a reply": "corrupt@{c}:offset=7:mask=0x40:to_controller",
    "another demand in a reply": "corrupt@{c}:offset=11:mask=0x02:to_controller",
    "time stamps begin again": "restart@{c}",
    "protective stop": "stop@{c}",
    "safeguard stop": "safeguard@{c}",
    "emergency stop": "emergency-stop@{c}",
    "power off": "power-off@{c}",
    "paused at the pendant": "pause@{c}",
    "stopped at the pendant": "halt@{c}",
    "freedrive": "freedrive@{c}x50",
    "slider at 50 %": "slider@{c}x50",
    "slider at 0 %": "slider@{c}x0",
    "pushed by 5°": "push@{c}x90",
    "pushed by 17°": "push@{c}x300",
}
"""Each fault as `hil simulate --fault` takes it, {c} for the cycle."""
SITUATIONS: Final = ("closed", "opening", "moving", "held", "exiting")
_IN_SHORT: Final[Mapping[str, str]] = {
    "protective stop": "protective stop",
    "safeguard stop": "safeguard stop",
    "emergency stop": "emergency stop",
    "power off": "power off",
    "was paused": "pause",
    "was stopped there": "stopped there",
    "no new set-point": "its program",
    "asked to stop": "its program",
    "no set-point reached": "its program",
    "too far from its set-point": "too far",
    "further than the arm": "leap",
    "nothing was received": "silence",
    "do not follow the last one": "stale frames",
    "ended as asked": "as asked",
}
"""Word for each reason by which a motion is lost, by a part of it."""
_FAST: Final = 0.6  # rad/s of joint 1: three quarters of its speed in this motion


@cache
def cell() -> Cell:
    return Cell.load(CELL_PATH).with_values({"controller.transport": "simulated"})


class _Peer(UrPeer):
    """A controller that has the parts of a simulated one that a run looks at."""

    @property
    def plant(self) -> Any:
        return self.controller.arm.plant


@dataclass
class UrRun(Run):
    """One session with one fault, and with a hold before it if `is_held`."""

    is_held: bool = False
    begun: int = field(default=0, init=False)

    def _make_session(self) -> JudgedUrSession:
        at = cell()
        limits = at.guard_limits
        settings = at.session_settings() | {"silence_timeout": SILENCE, "settle_cycles": 10}
        ring = CycleRing(6, 8192, state=state_of(settings))
        made = Session(at.drive_train, Guard(limits, at.period), ring, **settings)
        assert settings["mode"] == Mode.POSITION
        return JudgedUrSession(made, ring, UrConduct(limits, at.drive_train, at.period, at.max_gap))

    def _first_motion(self) -> TrajectoryPlayer:
        return _motion(cell().initial, 25.0)

    def _motion_afterwards(self) -> TrajectoryPlayer:
        position = self.controller.controller.outputs()["target_q"]
        return _motion(np.array(position), -15.0)

    @property
    def _no_controller(self) -> bool:
        return False

    def _make_ready(self) -> None:
        self.controller.controller.make_ready()

    def _is_fast(self, speed: Array) -> bool:
        return bool(speed[0] > _FAST)

    def _lost(self, reason: str) -> str:
        found = [word for part, word in _IN_SHORT.items() if part in reason]
        return found[0] if found else reason

    def _asked_for(self) -> str:
        return "refused:"

    def _fate(self) -> str:
        fate = super()._fate()
        reasons = [str(e.error) for e in self.events if type(e).__name__ == "Refused"]
        return f"refused: {_refusal(reasons[0])}" if fate.startswith("refused: Arm") else fate

    def _note_situation(self) -> None:
        super()._note_situation()
        session = self.session
        if self.is_held and session.state is State.OPEN and self._speed() < 1e-3 and self.begun:
            self.cycles.setdefault("held", self.transport.cycle)

    def _operate(self) -> None:
        """Hold the motion when it moves, and release it some time after the fault."""
        session = self.session
        if not (self.is_held and session.requested and session.state is State.OPEN):
            return
        moves = abs(session._ring.last(1)["commanded_velocity"][0, 0]) > 0.1
        if not self.begun and moves:
            self.begun = self.transport.cycle
            session.hold()
        elif self.begun and self.transport.cycle == self._released:
            session.resume()

    @property
    def _released(self) -> int:
        return max(self.begun + 300, self._over + 30)


def _refusal(message: str) -> str:
    """Return the word for a refusal of the controller's state."""
    words = ("freedrive", "speed slider", "slows the arm down", "deviation", "another program",
             "did not run")  # fmt: skip
    return next((word for word in words if word in message), message)


def _motion(start: Array, by: float) -> TrajectoryPlayer:
    target = start.copy()
    target[0] += np.radians(by)
    planned = plan_move(cell(), start, target, speed=0.5)
    return player_of(cell(), planned.motion.trajectory)


def controller(*faults: UrFault) -> _Peer:
    return _Peer(simulated_ur(cell(), faults=faults))


@cache
def cycles_without_a_fault(is_held: bool) -> Mapping[str, int]:
    """First cycle of each situation."""
    run = UrRun(controller(), True, is_held=is_held)
    run.play(())
    assert run.outcome == "completed", run.outcome
    assert not run.broken, run.broken
    return run.cycles


def play(fault: str, situation: str) -> UrRun:
    """Let a fault strike in a situation."""
    is_held = situation == "held"
    # The introduction is the transport's packet 0; the controller counts cycles from the next on.
    cycle = cycles_without_a_fault(is_held)[situation]
    line = FAULTS[fault]
    link: tuple[Any, ...] = ()
    of_controller: tuple[UrFault, ...] = ()
    if line in faulty_runs.FAULTS.values() or kind_of(line) in ("lose", "corrupt"):
        ((_, parsed),) = parse_script([line.format(c=cycle)]).faults
        link = split_faults([parsed])[0]
        count = getattr(parsed, "count", 1)
    else:
        of_controller = (parse_ur_fault(line.format(c=cycle - 1)),)
        count = of_controller[0].count if of_controller[0].kind == "freedrive" else 1
    run = UrRun(controller(*of_controller), True, is_held=is_held)
    run.play(link, cycle, cycle + count)
    return run


def cases() -> Iterator[tuple[str, str]]:
    for fault in FAULTS:
        for situation in SITUATIONS:
            yield fault, situation
