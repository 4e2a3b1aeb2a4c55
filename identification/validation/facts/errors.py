"""Facts about the torque error on held-out motion."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from identification.arrays import Array
from identification.hypotheses.little_torque import little_torque
from identification.text import percentage
from identification.validation.consistency import ELEMENTS
from identification.validation.evidence import Evidence
from identification.validation.finding import Finding, Mask, Naming, Thresholds, indices

UNEXPLAINED: Final = "unexplained error"
"""Name of the check whether any fault explains the error."""
LEFT_OPEN: Final = "left open by the motion"
"""Name of the check whether models of the same fit predict alike."""
# Ratio of torque errors that is no chance: three standard deviations of 24 blocks, as in 12 s.
_GROWN: Final = 1.5
# A wrong sign would increase the error of the fitted motion as well.
_NOT_COVERED: Final = (
    "fit a longer or more varied motion: the fitted motion does not cover the predicted one"
)


# Where torque and its prediction are noise of the same size, the error is this share of the torque.
_NOISE_ALONE: Final = 2.0**0.5


def _faster(joints: str) -> str:
    return f"move {joints} faster and further, so that the torque exceeds the noise"


def _drive(joints: str) -> str:
    return f"check sign, gear ratio and torque constant of {joints}, and the unit of the torque"


def _not_covered(_joints: str) -> str:
    return _NOT_COVERED


def _minor(evidence: Evidence, limits: Thresholds) -> Mask:
    """Return axes whose torque is too small to condemn a model alone (n,).

    It is lost in its noise, or small against that of the other axes or against its own limit.
    """
    error = evidence.held_out
    torque = error.torque_rms
    slides = np.isin(np.arange(len(torque)), evidence.prismatic)
    minor = little_torque(torque, slides, limits.minor) | _lost_in_noise(evidence, limits)
    if (most := evidence.context.torque_limit) is not None:
        minor |= torque < limits.minor_of_limit * np.nan_to_num(most)
    return np.asarray(minor & (error.rows > 0))


def _lost_in_noise(evidence: Evidence, limits: Thresholds) -> Mask:
    """Return axes whose torque is lost in its noise (n,)."""
    torque = evidence.held_out.torque_rms
    if evidence.noise_floor is None:
        return np.zeros(len(torque), dtype=np.bool_)
    return np.asarray(np.nan_to_num(evidence.noise_floor) > 0.5 * limits.axis * torque)


def _growth(evidence: Evidence, limits: Thresholds) -> tuple[Array, Mask]:
    """Return the error of each axis on held-out over fitted motion, and where it is large (n,)."""
    relative = evidence.held_out.relative
    times = relative / np.maximum(evidence.training.relative, 1e-12)
    # An error below that of a pattern is one of rounding or smoothing.
    return times, (times > limits.generalisation) & (relative > limits.pattern)


@dataclass(frozen=True, eq=False)
class ErrorFacts:
    """Errors as shares of the torque."""

    overall: float
    allowed: float  # of it
    relative: Array  # of each axis (n,)
    torque: tuple[str, ...]  # RMS torque of each axis, with its unit
    overall_large: bool
    overall_grown: bool  # whether that of the fitted motion does not cover it
    large: Mask  # axes beyond their limit (n,)
    grown: Mask  # axes whose error on the fitted motion does not cover it (n,)
    minor: Mask  # axes of little torque (n,)
    limits: Thresholds

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> ErrorFacts:
        """Compare the errors with their limits, and with those on the fitted motion."""
        error = evidence.held_out
        units = ["N·m" if evidence.revolute(joint) else "N" for joint in range(len(error.rows))]
        sizes = zip(error.torque_rms, units, strict=True)
        _, grown = _growth(evidence, limits)
        return cls(
            overall=error.overall,
            allowed=evidence.allowed(limits),
            relative=error.relative,
            torque=tuple(f"{size:.2g} {unit}" for size, unit in sizes),
            overall_large=error.overall > evidence.allowed(limits),
            overall_grown=error.overall > limits.generalisation * evidence.training.overall,
            large=error.relative > limits.axis,
            grown=grown,
            minor=_minor(evidence, limits),
            limits=limits,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield errors beyond their limits."""
        if self.overall_large:
            step = (
                f"describe {ELEMENTS}, if the arm has one, in [[robot.elements]] of the cell file;"
                " else check gear ratios, signs, torque constants and the delay between torque and"
                " position"
            )
            yield Finding(
                "error on unseen motion",
                "wrong",
                f"the torque error on {naming.motion} is {percentage(self.overall, 1)} over all"
                f" axes, limit {percentage(self.allowed)}",
                _NOT_COVERED if self.overall_grown else step,
                "symptom",
            )
        yield from self._of_axes(naming)

    def _of_axes(self, naming: Naming) -> Iterator[Finding]:
        check = "error on unseen motion"
        limit = percentage(self.limits.axis)

        def share(joint: int) -> str:
            return percentage(self.relative[joint])

        covered = self.large & ~self.grown & ~self.minor
        if covered.any():
            yield Finding(
                check,
                "wrong",
                f"the torque error on {naming.motion} exceeds {limit}:"
                f" {naming.each(covered, share)}",
                f"check sign, gear ratio and torque constant of {naming.of(covered)}, and whether"
                " the torque exceeds its noise",
                "symptom",
                joints=indices(covered),
            )
        minor = self.large & self.minor
        beyond = minor & (self.relative > _NOISE_ALONE)
        for joints, step in (
            (minor & ~beyond, _faster),
            (beyond & ~self.grown, _drive),
            (beyond & self.grown, _not_covered),
        ):
            if not joints.any():
                continue
            shares = naming.each(joints, lambda joint: f"{share(joint)} of {self.torque[joint]}")
            yield Finding(
                check,
                "doubtful",
                f"the torque error on {naming.motion} exceeds {limit} for axes of little torque:"
                f" {shares}",
                step(naming.of(joints)),
                "symptom",
                joints=indices(joints),
            )
        grown = self.large & self.grown & ~self.minor
        if grown.any():
            yield Finding(
                check,
                "wrong",
                f"the torque error on {naming.motion} exceeds {limit}: {naming.each(grown, share)}",
                _NOT_COVERED,
                "symptom",
                joints=indices(grown),
            )


@dataclass(frozen=True)
class UnexplainedFacts:
    """Error far above the noise that no tested fault explains."""

    overall: float
    floor: float  # noise floor, as a share of the torque
    large: bool
    beyond: bool  # whether the model is not good for it

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> UnexplainedFacts | None:
        """Compare the error with the noise; None if faults were found, or not tested."""
        floor = evidence.floor
        found = evidence.explanations
        if floor is None or found is None or found:
            return None
        overall = evidence.held_out.overall
        large = overall > max(limits.unexplained, limits.multiple * floor)
        return cls(overall, floor, large, overall > evidence.allowed(limits))

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield the error."""
        if self.large:
            multiple = self.overall / max(self.floor, 1e-300)
            yield Finding(
                UNEXPLAINED,
                "wrong" if self.beyond else "doubtful",
                f"the torque error on {naming.motion} is {percentage(self.overall, 1)},"
                f" {multiple:.1f} times the noise floor of {percentage(self.floor, 1)}; none of the"
                " tested faults explains it (delay, torque constants, signs and order of joints,"
                " payload, changes between recordings)",
                "check for effects that the model lacks: friction curves of the report,"
                " elasticity, springs or balancers ([[robot.elements]] of the cell file),"
                " temperature",
                "symptom",
            )


@dataclass(frozen=True)
class OpenFacts:
    """Error on unseen motion that comes from what the fitted motion leaves open."""

    share: float  # deviation of the predicted torque by the posterior, of the torque
    overall: float
    fitted: float

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> OpenFacts | None:
        """Compare it with the error; None if that is small, or less is open."""
        share = evidence.open_share
        overall = evidence.held_out.overall
        if share is None or not share >= overall > limits.unexplained:
            return None
        return cls(share, overall, evidence.training.overall)

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield that the error does not tell models of the same fit apart."""
        yield Finding(
            LEFT_OPEN,
            "doubtful",
            f"parameters that fit the recording equally well (to {percentage(self.fitted, 1)})"
            f" deviate by {percentage(self.share, 1)} of the torque on {naming.motion}, since the"
            f" fitted motion leaves them open; the error of {percentage(self.overall, 1)} there"
            " does not tell a fault of such an effect (low sampling rate, coarse resolution, small"
            " payload) from chance",
            f"{_NOT_COVERED}, in which every joint moves in both directions",
        )


@dataclass(frozen=True, eq=False)
class ExplainedFacts:
    """Share of the torque variance of each axis that the model explains."""

    explained: Array  # (n,), NaN where unknown
    none: Mask  # axes that the mean predicts as well (n,)
    little: Mask  # axes of which little is explained (n,)
    beyond: Mask  # axes whose error exceeds what noise alone explains (n,)
    limits: Thresholds

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> ExplainedFacts:
        """Compare the shares with their limits."""
        explained = evidence.held_out.explained
        none = (explained <= limits.explained) & ~_minor(evidence, limits)
        little = (explained < limits.little_explained) & ~none
        beyond = evidence.held_out.relative > _NOISE_ALONE
        return cls(explained, none, little, beyond, limits)

    def _parts(self, mask: Mask) -> Iterator[tuple[Mask, Callable[[str], str]]]:
        """Yield the axes that noise may explain and the others, each with the next step."""
        for part, step in ((mask & ~self.beyond, _faster), (mask & self.beyond, _drive)):
            if part.any():
                yield part, step

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield axes of which little is explained, or the least explained one."""
        check = "variance explained (R²)"
        for mask, step in self._parts(self.none):
            joints = naming.of(mask)
            yield Finding(
                check,
                "wrong",
                f"the model of {joints} predicts no better than the mean torque (R² at most"
                f" {self.limits.explained:g})",
                step(joints),
                "symptom",
            )
        for mask, step in self._parts(self.little):
            shares = naming.each(mask, lambda joint: percentage(self.explained[joint]))
            yield Finding(
                check,
                "doubtful",
                f"the model explains less than {percentage(self.limits.little_explained)} of the"
                f" torque variance: {shares}",
                step(naming.of(mask)),
                "symptom",
            )
        enough = not (self.none | self.little).any()
        if enough and not np.all(np.isnan(self.explained)):
            least = int(np.nanargmin(self.explained))
            yield Finding(
                check,
                "good",
                f"the model explains at least {percentage(self.explained[least], 1)} of the torque"
                f" variance of each axis (lowest: {naming.joints[least]})",
            )


@dataclass(frozen=True, eq=False)
class GeneralisationFacts:
    """Error of each axis on held-out over fitted motion."""

    relative: Array  # error on held-out motion (n,)
    times: Array  # that of the fitted motion (n,)
    far: Mask  # axes whose error is also large (n,)
    little: Mask  # the others (n,)
    limit: float  # of the ratio

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> GeneralisationFacts:
        """Compare the ratios with their limit."""
        error = evidence.held_out
        times, grown = _growth(evidence, limits)
        # Less torque on unseen motion alone raises the share.
        ratio = error.rms / np.maximum(evidence.training.rms, 1e-300)
        least = np.where(ratio > _GROWN, limits.unexplained, 0.5 * limits.axis)
        # Little torque does not excuse an axis that was fitted several times better.
        far = grown & (error.relative > least) & ~_lost_in_noise(evidence, limits)
        return cls(error.relative, times, far, grown & ~far, limits.generalisation)

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield axes of a large ratio."""
        if self.far.any():
            yield self._finding(naming, self.far, wrong=True)
        if self.little.any():
            yield self._finding(naming, self.little, wrong=False)

    def _finding(self, naming: Naming, joints: Mask, *, wrong: bool) -> Finding:
        ratios = naming.each(
            joints,
            lambda joint: f"{self.times[joint]:.1f} times, {percentage(self.relative[joint], 1)}",
        )
        return Finding(
            "generalisation",
            "wrong" if wrong else "doubtful",
            f"the torque error on {naming.motion} is more than {self.limit:g} times that of the"
            f" fitted motion: {ratios}",
            f"{_NOT_COVERED}; if it does, check what changed for {naming.of(joints)} between the"
            " recordings",
            "symptom",
            joints=indices(joints),
        )


@dataclass(frozen=True, eq=False)
class SystematicFacts:
    """Slow errors beyond noise, which repetitions show."""

    repeated: bool
    share: Array  # of the torque (n,)
    large: Mask  # axes beyond the limit, whatever their friction (n,)
    noticeable: Mask  # axes beyond the lower limit (n,)
    limits: Thresholds

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> SystematicFacts:
        """Compare the shares with their limits."""
        share = evidence.systematic
        apart = evidence.systematic_without_friction
        repeated = share is not None
        share = np.zeros(len(evidence.held_out.rows)) if share is None else np.nan_to_num(share)
        beyond = (share if apart is None else np.nan_to_num(apart)) > limits.systematic
        return cls(
            repeated=repeated,
            share=share,
            large=(share > limits.systematic) & beyond,
            noticeable=(share > limits.noticeable) & (share <= limits.systematic),
            limits=limits,
        )

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield axes of large errors."""
        if not self.repeated:
            yield Finding(
                "systematic error",
                "doubtful",
                "without repetitions of one motion, errors of the drive train (coupling, torque"
                " constant) cannot be distinguished from noise and were not tested",
                "record the same motion several times",
            )
        if self.large.any():
            yield Finding(
                "systematic error",
                "wrong",
                self._message(naming, self.large, self.limits.systematic),
                f"check sign, gear ratio, coupling and torque constant of {naming.of(self.large)}",
                "symptom",
                joints=indices(self.large),
            )
        if self.noticeable.any():
            yield Finding(
                "systematic error",
                "doubtful",
                self._message(naming, self.noticeable, self.limits.noticeable),
                f"check the torque constant of {naming.of(self.noticeable)} with a known payload"
                " (`hil torque-constants`), or without gravity load against the drive's data sheet",
                "symptom",
                joints=indices(self.noticeable),
            )

    def _message(self, naming: Naming, joints: Mask, limit: float) -> str:
        shares = naming.each(joints, lambda joint: percentage(self.share[joint], 1))
        return (
            f"the torque error on {naming.motion} beyond noise exceeds {percentage(limit, 1)}:"
            f" {shares}"
        )


@dataclass(frozen=True, eq=False)
class RepetitionFacts:
    """Torque difference between the estimates of single repetitions and the pooled one."""

    disagreement: Array  # the largest, as a share of the torque (n,)
    limit: float

    @classmethod
    def of(cls, evidence: Evidence, limits: Thresholds) -> RepetitionFacts | None:
        """Return the differences; None without repetitions that can be compared."""
        share = evidence.disagreement
        # Undetermined parameters vary between repetitions.
        if share is None or evidence.estimate.undetermined:
            return None
        return cls(share, limits.inconsistency)

    def findings(self, naming: Naming) -> Iterator[Finding]:
        """Yield axes of a large difference."""
        joints = self.disagreement > self.limit
        if joints.any():
            shares = naming.each(joints, lambda joint: percentage(self.disagreement[joint]))
            yield Finding(
                "repetitions",
                "wrong",
                "the estimates of single repetitions differ by more than"
                f" {percentage(self.limit)} of the torque: {shares}",
                "compare the repetitions: conditions changed between them",
            )
