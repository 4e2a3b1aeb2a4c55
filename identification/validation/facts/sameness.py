"""Facts about what differs on held-out motion: the load, the torque of a joint, its friction."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.hypotheses.unseen_changes import ChangeKind
from identification.text import percentage
from identification.validation.evidence import Evidence
from identification.validation.facts.faults import GravityFacts, is_constant
from identification.validation.finding import Finding, Mask, Naming, Thresholds, indices
from identification.validation.prediction import FRICTION_CHANGE

WARMER: Final = "warm the arm up by moving it before recording"
"""What to do against friction that changes."""


@dataclass(frozen=True)
class LoadFacts:
    """A body on the last link on held-out motion only."""

    carried: bool
    mass: str  # difference to the fitted motion [kg]
    explained: float  # share of the additional error

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> LoadFacts | None:
        """Decide whether it is a load."""
        load = evidence.load
        if load is None:
            return None
        most = 2 * load.axes >= len(evidence.held_out.rows)
        half = f" ± {load.half_interval:.2g}" if np.isfinite(load.half_interval) else ""
        # A mass whose interval includes zero is no load; one without an interval is not known.
        certain = not load.half_interval < np.inf or abs(load.mass) > load.half_interval
        return cls(
            carried=load.explained >= limits.load and most and certain,
            mass=f"{abs(load.mass):.3g}{half} kg {'more' if load.mass > 0.0 else 'less'}",
            explained=load.explained,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the load."""
        if self.carried:
            yield Finding(
                "load",
                "wrong",
                f"on {naming.motion} the arm carried {self.mass} than on the fitted motion: a body"
                f" on the last link explains {percentage(self.explained)} of the additional error",
                "record both with the same tool and payload, or state the payload of each in its"
                " cell file",
                "cause",
            )


@dataclass(frozen=True, eq=False)
class ChangeFacts:
    """Joints whose torque or friction on held-out motion is a multiple of that of the fitted."""

    ratio: Array  # held-out over fitted motion (n,), NaN of a joint that did not change
    half_interval: Array  # of 95 % (n,)
    gain: Mask  # joints of another torque (n,)
    friction: Mask  # joints of other friction (n,)
    alike: Mask  # those of them whose torque may be another as well (n,)
    matters: Mask  # joints with an error that has to be explained (n,)
    noticed: Mask  # joints with an error that is not one of rounding (n,)

    @classmethod
    def of(
        cls,
        evidence: Evidence,
        limits: Thresholds,
        load: LoadFacts | None,
        gravity: GravityFacts | None,
    ) -> ChangeFacts | None:
        """Return the changes; None if another cause would be read as changes of joints."""
        # Or it has spoilt the parameters.
        if (load is not None and load.carried) or (gravity is not None and gravity.off):
            return None
        # A gain of the fitted motion has not: of that motion only, it is what changed.
        others = [each for each in evidence.explanations or () if not is_constant(each.change)]
        if any(each.change.is_discrete or each.ratio < limits.cause for each in others):
            return None
        if evidence.diagnosis is not None and evidence.diagnosis.begun:
            return None
        error = evidence.held_out
        ratio, half_interval = np.full((2, len(error.rows)), np.nan)
        for change in evidence.changes:
            ratio[change.joint] = change.ratio
            half_interval[change.joint] = 2.0 * change.std
        return cls(
            ratio=ratio,
            half_interval=half_interval,
            gain=_joints_of(evidence, "gain"),
            friction=_joints_of(evidence, "friction"),
            alike=np.isin(
                np.arange(len(error.rows)), [each.joint for each in evidence.changes if each.alike]
            ),
            matters=error.relative > limits.unexplained,
            # An error below that of a pattern is one of rounding or smoothing.
            noticed=error.relative > limits.pattern,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints of another torque."""
        yield from self._gains(naming, self.gain & self.matters, wrong=True)
        yield from self._gains(naming, self.gain & ~self.matters, wrong=False)

    def _gains(self, naming: Naming, joints: Mask, *, wrong: bool) -> Iterator[Finding]:
        if not joints.any():
            return
        ratios = naming.each(
            joints, lambda joint: f"{self.ratio[joint]:.3g} ± {self.half_interval[joint]:.2g}"
        )
        yield Finding(
            "sameness",
            "wrong" if wrong else "doubtful",
            f"the torque on {naming.motion} differs from that of the fitted motion by a factor:"
            f" {ratios}",
            f"check what changed for {naming.of(joints)} between the recordings: torque constant,"
            " unit or scale of the torque, drive settings; identify the recordings of each state"
            " separately",
            "cause",
        )


def _joints_of(evidence: Evidence, kind: ChangeKind) -> Mask:
    """Return the joints that have changed in this way (n,)."""
    joints = [change.joint for change in evidence.changes if change.kind == kind]
    return np.isin(np.arange(len(evidence.held_out.rows)), joints)


@dataclass(frozen=True, eq=False)
class FrictionFacts:
    """Joints whose friction on held-out motion differs from the estimate."""

    change: Array  # relative (n,)
    joints: Mask  # whose change is to be named (n,)
    axes: Mask  # whose error it explains (n,)
    alike: Mask  # axes of which another torque explains it as well (n,)
    wrong: bool  # whether it is beyond what temperature causes
    limit: float  # of a change that is not named

    @classmethod
    def of(
        cls, evidence: Evidence, limits: Thresholds, changes: ChangeFacts | None
    ) -> FrictionFacts | None:
        """Use changes beyond temperature, else repetitions, which tell friction from noise."""
        by_factor = None if changes is None else cls._of_changes(changes, limits)
        change = evidence.friction_change
        if change is None or (by_factor is not None and by_factor.wrong):
            return by_factor
        nothing = np.zeros(len(evidence.held_out.rows))
        share = evidence.systematic
        apart = evidence.systematic_without_friction
        share = nothing if share is None else np.nan_to_num(share)
        beyond = (share if apart is None else np.nan_to_num(apart)) > limits.systematic
        explained = (share > limits.systematic) & ~beyond
        return cls(
            change=change,
            joints=explained | ((np.abs(change) > limits.friction) & ~beyond),
            axes=explained,
            alike=np.zeros_like(explained),
            wrong=bool(explained.any()),
            limit=limits.friction,
        )

    @classmethod
    def _of_changes(cls, changes: ChangeFacts, limits: Thresholds) -> FrictionFacts:
        change = changes.ratio - 1.0
        joints = changes.friction
        far = joints & changes.noticed & (np.abs(change) > FRICTION_CHANGE)
        return cls(
            change,
            joints,
            axes=joints,
            alike=joints & changes.alike,
            wrong=bool(far.any()),
            limit=limits.friction,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints of other friction."""
        if not self.joints.any():
            return
        changes = naming.each(
            self.joints, lambda joint: percentage(self.change[joint], signed=True)
        )
        other = step = ""
        if self.alike.any():
            # A joint of little more than friction.
            other = f"; another torque constant of {naming.of(self.alike)} explains it as well"
            step = f", and check what else changed for {naming.of(self.alike)}"
        if self.wrong:
            yield Finding(
                "friction",
                "wrong",
                f"friction on {naming.motion} differs from the estimate: {changes}, beyond the"
                f" {percentage(FRICTION_CHANGE)} that gear temperature causes; this explains the"
                f" error of {naming.of(self.axes)}{other}",
                WARMER + step,
                "cause",
                joints=indices(self.joints),
            )
        else:
            yield Finding(
                "friction",
                "doubtful",
                f"friction on {naming.motion} differs by more than {percentage(self.limit)}:"
                f" {changes}; gear temperature may have changed{other}",
                WARMER + step,
                "cause",
                reservation=f"friction of {naming.of(self.joints)} changed",
                joints=indices(self.joints),
            )
