"""Where every axis is to be at the next tick, and who says so.

Open axes are led by the PC (modes 1, 4, 5) or go on as the controller leads them, corrected by the
PC (modes 2, 7, 8, 9). How the real controller applies each field is not documented. What is done
here is a guess:

    mode 1     D1 and D2 are the target; D4 takes the place of D2 in the speed that the velocity
               loop is given, D5 is added to the target current
    mode 4, 5  D1 and D2 are the target
    mode 2     D4 is added to the speed, D5 to the target current
    mode 7     D1 is added to the controller's own target, which is also what it reports
    mode 8     D4 is added to the speed
    mode 9     D5 is added to the target current

An axis that nobody leads holds its target, or comes to rest on the controller's own ramp.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import copysign
from typing import NamedTuple

from sim_fixtures.drive import SimulatedDrive
from sim_fixtures.own_motion import OwnMotion
from sim_fixtures.program import LoopProgram, Phase
from sim_fixtures.servo import Servo
from sim_fixtures.settings import ControllerSettings

Numbers = Sequence[float]
Wanted = Sequence[Sequence[float] | None]
"""D1..D5 that the PC answered for each axis; None for an axis without an answer to be taken."""

_ADDS_SPEED = (2, 8)
_ADDS_CURRENT = (1, 2, 9)


class Demand(NamedTuple):
    """What the servo is to do until the next tick; motor side, (n,) each.

    Attributes:
        target: rev.
        delta: rev per cycle.
        speed: added to the speed demanded, rev per cycle.
        current: added to the target current, A.
    """

    target: list[float]
    delta: list[float]
    speed: list[float]
    current: list[float]


class Targets:
    """Makes the demands, cycle by cycle.

    Attributes:
        own: the targets that the controller reports, (n,) [motor rev].
        own_delta: their speed, (n,) [motor rev per cycle].
    """

    def __init__(
        self, drive: SimulatedDrive, settings: ControllerSettings, own_motion: OwnMotion | None
    ) -> None:
        n = drive.n_axes
        self._drive = drive
        self._settings = settings
        self._motion = own_motion
        self._moving = False
        self._broken_off = False
        self._offset = [0.0] * n
        self._ramp = [0.0] * n
        self.own = [0.0] * n
        self.own_delta = [0.0] * n

    @property
    def own_motion_done(self) -> bool:
        """Whether the controller's own program has nothing left to do."""
        return self._motion is None or self._motion.finished

    def release(self, servo: Servo) -> None:
        """The drive is off: targets are where the motors stand, an own motion is over for good."""
        self.own, self.own_delta = list(servo.target), list(servo.delta)
        self._offset = [0.0] * len(self.own)
        self._break_off()

    def _break_off(self) -> None:
        """The drive was lost: an own motion under way is not taken up again."""
        self._broken_off = self._broken_off or self._moving
        self._moving = False

    def end_own_motion(self) -> None:
        """Finish the move under way, if there is one, and begin no other."""
        if self._motion is not None:
            self._motion.end()

    def advance(self, servo: Servo, program: LoopProgram, wanted: Wanted) -> Demand:
        """Return the demand of the cycle that begins.

        Args:
            servo: at the present tick.
            program: says which axes are open and whether the PC is listened to.
            wanted: what the PC answered, (n,).
        """
        demand = self._lead(servo, program)
        if self._settings.corrected and program.listening:
            self.own, self.own_delta = list(demand.target), list(demand.delta)
            self._correct(demand, wanted)
        else:
            if not self._settings.corrected:
                self._follow(demand, wanted)
            self.own, self.own_delta = demand.target, demand.delta
            self._offset = [0.0] * len(self.own)
        return demand

    def _lead(self, servo: Servo, program: LoopProgram) -> Demand:
        """Return what the controller does by itself."""
        n = self._drive.n_axes
        zero = [0.0] * n
        corrected = self._settings.corrected and program.listening
        if self._plays(program):
            return Demand(*self._play(), zero, list(zero))
        if not program.powered:
            self._break_off()
        self._moving = False
        if corrected:
            return Demand(list(self.own), list(zero), zero, list(zero))
        goes_on = self._settings.while_silent == "continue"
        target, delta = list(servo.target), [0.0] * n
        for i, before in enumerate(servo.delta):
            if before == 0.0 or not goes_on:
                self._ramp[i] = 0.0
                continue
            delta[i] = self._slow_down(i, before, program)
            target[i] += 0.5 * (before + delta[i])
        return Demand(target, delta, zero, list(zero))

    def _slow_down(self, axis: int, before: float, program: LoopProgram) -> float:
        """Return the speed after `before` of an axis that nobody leads in this cycle."""
        if program.listening and program.open_axes[axis]:
            self._ramp[axis] = 0.0
            return before
        if self._ramp[axis] == 0.0:
            self._ramp[axis] = abs(before) * self._settings.period / self._settings.ramp_time
        return copysign(max(0.0, abs(before) - self._ramp[axis]), before)

    def _plays(self, program: LoopProgram) -> bool:
        """Whether the controller's own motion goes on in this cycle."""
        phase = Phase.OPEN if self._settings.corrected else Phase.MOVING
        there_is_one = self._motion is not None and not self._broken_off
        return there_is_one and program.phase is phase

    def _play(self) -> tuple[list[float], list[float]]:
        """Return the own motion's next target and its speed."""
        assert self._motion is not None
        if not self._moving:
            self._moving = True
            self._motion.begin(self._drive.joint_angles(self.own))
        position, velocity = self._motion.advance()
        period = self._settings.period
        target = self._drive.motor_revolutions(position.tolist())
        return target, [period * v for v in self._drive.motor_speeds(velocity.tolist())]

    def _follow(self, demand: Demand, wanted: Wanted) -> None:
        """Let the PC's targets take the place of the controller's."""
        feeds = self._settings.open_mode == 1
        for i, fields in enumerate(wanted):
            if fields is None:
                continue
            demand.target[i], demand.delta[i] = fields[0], fields[1]
            self._ramp[i] = 0.0
            if feeds:
                demand.speed[i] = fields[3] - fields[1]
                demand.current[i] = fields[4]

    def _correct(self, demand: Demand, wanted: Wanted) -> None:
        """Let the PC's corrections act on the controller's own targets."""
        mode = self._settings.open_mode
        for i, fields in enumerate(wanted):
            before = self._offset[i]
            if fields is not None:
                if mode == 7:
                    self._offset[i] = fields[0]
                if mode in _ADDS_SPEED:
                    demand.speed[i] = fields[3]
                if mode in _ADDS_CURRENT:
                    demand.current[i] = fields[4]
            demand.target[i] += self._offset[i]
            demand.delta[i] += self._offset[i] - before
