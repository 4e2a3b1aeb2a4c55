"""Facts about the recordings: joints that were tested, position jumps, delay, limits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, Literal

from identification.arrays import Array
from identification.text import percentage
from identification.validation.evidence import SIGMAS, Evidence
from identification.validation.finding import Finding, Mask, Naming, Thresholds, joined

UNTESTED: Final = "tested"
"""Name of the check whether every joint was tested on held-out motion."""
_JUMPS_SHOWN: Final = 3


@dataclass(frozen=True, eq=False)
class TestedFacts:
    """Whether each joint was tested on held-out motion."""

    in_sample: bool  # whether nothing was held out
    still: Mask  # joints that hardly moved (n,)
    silent: Mask  # joints without a torque (n,)
    least: float  # time in which a joint must have moved [s]

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> TestedFacts:
        """Compare the time in which each joint moved with the limit."""
        error = evidence.held_out
        return cls(
            in_sample=evidence.in_sample,
            still=error.rows == 0 if evidence.moved is None else evidence.moved < limits.moved,
            silent=(error.rows > 0) & (error.torque_squared == 0.0),
            least=limits.moved,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield what was not tested."""
        if self.in_sample:
            yield Finding(
                UNTESTED,
                "wrong",
                "no motion was held out: all errors are in-sample",
                "predict a recording that is not fitted (`hil identify --predict ARCHIVE`)",
            )
        if self.still.any():
            joints = naming.of(self.still)
            yield Finding(
                UNTESTED,
                "wrong",
                f"{joints} moved for less than {self.least:g} s of {naming.motion}",
                f"record a validation motion that moves {joints}; a joint that must not move is"
                " locked (`locked` under [robot] in the cell file, or `hil import log --held"
                " JOINT`)",
            )
        if self.silent.any():
            joints = naming.of(self.silent)
            yield Finding(
                UNTESTED,
                "wrong",
                f"the measured torque of {joints} is zero throughout {naming.motion}",
                f"record the torque of {joints} with sufficient resolution",
            )


@dataclass(frozen=True)
class JumpFacts:
    """Steps of measured positions that an arm cannot make."""

    jumps: tuple[str, ...]  # each with joint, size, time and recording, the largest first
    joints: tuple[str, ...]

    @classmethod
    def of(cls, evidence: Evidence) -> JumpFacts:
        """Describe the jumps."""
        jumps = sorted(evidence.context.jumps, key=lambda jump: -abs(jump.size))
        return cls(
            jumps=tuple(
                f"{jump.joint} by {jump.size:+.3g} after {jump.time:.3f} s of {jump.recording}"
                for jump in jumps
            ),
            joints=tuple(dict.fromkeys(jump.joint for jump in jumps)),
        )

    def findings(self, _: Naming) -> Iterator[Finding]:
        """Yield the jumps."""
        if self.jumps:
            yield Finding(
                "position jumps",
                "wrong",
                "the measured position jumped faster than an arm can move (rad or m):"
                f" {joined(self.jumps, _JUMPS_SHOWN)}",
                f"check encoder, coupling and cable of {joined(self.joints)} and record again, or"
                " cut the recording before the jump",
                "cause",
            )


@dataclass(frozen=True)
class CorrectionFacts:
    """Faults of the recordings that were corrected before the fit."""

    corrections: tuple[Finding, ...]

    @classmethod
    def of(cls, evidence: Evidence) -> CorrectionFacts:
        """Take over those of the preparation."""
        return cls(evidence.context.corrections)

    def findings(self, _: Naming) -> Iterator[Finding]:
        """Yield them as they are."""
        yield from self.corrections


_DelayOutcome = Literal["compensated", "differs", "suspected", "as assumed"]


@dataclass(frozen=True)
class DelayFacts:
    """Delay of the torque behind the position [ms]."""

    delay: float
    half_interval: float  # of 95 %
    stated: float
    assumed: float  # in the fit
    tolerance: float  # below which a difference from it does not matter
    outcome: _DelayOutcome | None  # None: not determined

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> DelayFacts | None:
        """Compare the estimated delay with the assumed one."""
        delays = evidence.context.delays
        assumed = evidence.context.assumed_delay
        if delays is None or evidence.context.commanded_positions:
            return None  # behind commands it is the lag of the servo
        # With a poor motion a delay cannot be separated from the parameters.
        estimate = evidence.estimate
        poor = bool(estimate.undetermined) or estimate.condition > limits.condition
        beyond = max(limits.delay * delays.cycle, SIGMAS * delays.std)
        differs = abs(delays.delay - assumed) > beyond
        outcome: _DelayOutcome | None = None
        far = abs(delays.delay - delays.assumed) > beyond  # and yet combined with what is stated
        if delays.significant and (
            assumed == delays.applied or (far and assumed != delays.assumed)
        ):
            outcome = "compensated"
        elif delays.determined and not poor:
            outcome = "differs" if differs else "as assumed"
        elif delays.significant and differs:
            outcome = "suspected"
        return cls(
            delay=1e3 * delays.delay,
            half_interval=1e3 * delays.half_interval,
            stated=1e3 * delays.assumed,
            assumed=1e3 * assumed,
            tolerance=1e3 * beyond,
            outcome=outcome,
        )

    def findings(self, _: Naming) -> Iterator[Finding]:
        """Yield what was found of the delay."""
        estimate = f"{self.delay:.3g} ± {self.half_interval:.2g} ms"
        if self.outcome == "compensated":
            what = "this" if self.assumed == self.delay else f"{self.assumed:.3g} ms"
            yield Finding(
                "delay",
                "doubtful",
                f"the torque lags the position by {estimate} ({self.stated:.3g} ms stated); {what}"
                " was compensated",
                "state it (`hil identify --delay SECONDS`), or correct it at its source",
            )
        elif self.outcome == "suspected":
            yield Finding(
                "delay",
                "doubtful",
                f"the torque probably lags the position by {estimate} ({self.assumed:.3g} ms"
                " assumed); this was not compensated, as the interval is wide and parts of the"
                " fitted motion are not predicted clearly better",
                "compare with `hil identify --delay auto`, or state the delay if it is known"
                " (`--delay SECONDS`)",
            )
        elif self.outcome == "differs":
            yield Finding(
                "delay",
                "doubtful",
                f"the delay of the torque differs from the assumed one: {estimate}"
                f" ({self.assumed:.3g} ms assumed)",
                "compare with `hil identify --delay auto`, or correct the delay in the cell",
                "cause",
            )
        elif self.outcome == "as assumed":
            used = "" if self.assumed == self.stated else f", {self.assumed:.3g} ms in the fit"
            what = f"the torque lags the position by {estimate}"
            within = f"within {self.tolerance:.2g} ms of what the fit assumed"
            if abs(self.delay - self.assumed) <= self.half_interval:
                within = "which agrees with what the fit assumed"
            yield Finding(
                "delay",
                "good",
                f"{what} ({self.stated:.3g} ms stated{used}), {within}",
            )


@dataclass(frozen=True, eq=False)
class SaturationFacts:
    """Samples in which torque or current was at its limit."""

    share: Array  # of samples (n,)
    full: Mask  # joints with too many (n,)

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> SaturationFacts | None:
        """Compare the shares with their limit."""
        share = evidence.context.saturated
        return None if share is None else cls(share, share > limits.saturated)

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the joints at their limit, or that there are none."""
        if not self.full.any():
            yield Finding("saturation", "good", "no torque or current was at its limit")
            return
        shares = naming.each(
            self.full, lambda joint: f"in {percentage(self.share[joint], 1)} of its samples"
        )
        yield Finding(
            "saturation",
            "doubtful",
            f"torque or current was at its limit: {shares}; the true value may be larger",
            f"slow the motion down where {naming.of(self.full)} is at its limit",
            "cause",
        )
