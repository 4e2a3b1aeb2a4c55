"""The person at a running campaign: what is shown to them, and what they request."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from .motion_watch import MotionProgress, OperatorRequest

Array = NDArray[np.float64]

Phase = Literal["dry run", "warm-up", "standstill", "repetition", "validation", "move"]
"""What a motion is for, in the words of the screen. A "move" is a way between the others."""


@dataclass(frozen=True, eq=False)
class DriftCurve:
    """How friction changes while the joints warm up, from one motion to the next.

    Attributes:
        joint_names: of the n joints.
        friction: (k, n) friction of each motion so far [N·m], by the measure of `warmup`.
        change: (k,) largest change of any joint from the motion before, as a share of its
            friction; NaN for the first.
        threshold: change below which the joints count as warm.
    """

    joint_names: tuple[str, ...]
    friction: Array
    change: Array
    threshold: float


@dataclass(frozen=True, eq=False)
class RunStatus:
    """Where a run stands, about ten times a second while something moves.

    Attributes:
        phase: what the motion is for.
        number: which of its kind, from 1.
        total: how many there are of its kind; of a warm-up, how many there may be.
        time_left: of motion to the end of the run, the present one at its override [s]; of a
            warm-up, whose length nobody knows, at least as many motions as it has to have.
        motions_left: after the present one.
        motion: of the motion that is being run; None between two.
        drift: of the warm-up so far, None where there is none.
        notes: on the quality of the last repetitions, newest last.
    """

    phase: Phase
    number: int
    total: int
    time_left: float
    motion: MotionProgress | None = None
    drift: DriftCurve | None = None
    notes: tuple[str, ...] = field(default=())
    motions_left: int = 0


@dataclass(frozen=True, eq=False)
class DryRunSummary:
    """What a person accepts or not.

    Attributes:
        campaign: name of the folder.
        plan_hash: of exactly this plan.
        archives: file names of its archives, one for each motion of the plan.
        override: largest share of full speed it was run at.
        duration: the motions took [s].
        simulated: whether nothing but a simulated arm moved.
        joint_names: of the n joints.
        current_share: (n,) largest current of each motor, as a share of its limit.
        following_error: (n,) largest distance of each joint from its command [rad].
        missed: packets that never arrived.
        late: packets whose answer was late.
        against_gravity: joints whose torque runs against the gravity of the nominal model; they
            are to be accepted by name, not by the way.
        gravity_not_seen: joints with too little gravity, beside friction, to tell.
    """

    campaign: str
    plan_hash: str
    archives: tuple[str, ...]
    override: float
    duration: float
    simulated: bool
    joint_names: tuple[str, ...]
    current_share: Array
    following_error: Array
    missed: int
    late: int
    against_gravity: tuple[str, ...] = ()
    gravity_not_seen: tuple[str, ...] = ()


class Operator(Protocol):
    """Who watches a run.

    `show` and `request` are called from the loop that supervises the motion and must return at
    once: no stop and no hold is passed on meanwhile. On a real link the arm is brought to rest on
    its path when one of them takes longer than a second. One that raises costs only what it shows.
    """

    @property
    def can_answer(self) -> bool:
        """Whether there is a person to accept a dry run."""
        ...

    def show(self, status: RunStatus) -> None:
        """Show where the run stands."""
        ...

    def request(self) -> OperatorRequest:
        """Return what the person requests now: override and hold."""
        ...

    def accept_dry_run(self, summary: DryRunSummary) -> bool:
        """Ask whether the slow motion looked right; False where nobody can answer."""
        ...


class Unattended:
    """Nobody watches: full speed, no hold, and no dry run is accepted."""

    @property
    def can_answer(self) -> bool:
        """Nobody is there."""
        return False

    def show(self, status: RunStatus) -> None:
        """Show nothing."""
        del status

    def request(self) -> OperatorRequest:
        """Full speed."""
        return OperatorRequest()

    def accept_dry_run(self, summary: DryRunSummary) -> bool:
        """Nobody has seen it."""
        del summary
        return False
