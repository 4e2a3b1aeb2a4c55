"""What the estimate itself says: undetermined, impossible, or not the drive train's."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from identification.validation.evidence import SIGMAS, Evidence
from identification.validation.findings.finding import Finding, joined
from identification.validation.thresholds import Thresholds

_RICHER = "design a motion for this arm (`hil design`) and record that"


def determined(_: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Parameters the motion says nothing about, alone or in combination."""
    names, condition = evidence.estimate.undetermined, evidence.estimate.condition
    if names:
        yield Finding(
            "excitation",
            "wrong",
            f"the motion does not determine {joined(names, len(names))}",
            _RICHER,
        )
        return
    text = f"condition number {condition:.0f} of the regressor with columns of unit length"
    coupling = evidence.coupling
    if coupling is not None and np.isfinite(coupling.index):
        text += f", coupling index {coupling.index:.0f} of at most {coupling.largest:.0f}"
    if condition > limit.condition:
        yield Finding(
            "excitation",
            "doubtful",
            f"the motion excites the parameters poorly ({text}; good motions stay below"
            f" {limit.condition:.0f}): trust the predictions on motions like this one rather than"
            " single parameters",
            _RICHER,
        )
    else:
        yield Finding("excitation", "good", f"the motion determines every parameter ({text})")


def plausible(_: Sequence[str], evidence: Evidence, __: Thresholds) -> Iterator[Finding]:
    """Signs that nature does not make."""
    for words in evidence.implausible.impossible:
        yield Finding(
            "physical signs",
            "wrong",
            words,
            "check the sign of the torque and the direction of each axis in the column map or cell",
            "symptom",
        )
    for words in evidence.implausible.doubtful:
        yield Finding(
            "physical signs",
            "doubtful",
            words,
            "where a model must be physical (simulation, URDF), take the consistent estimate",
        )


def systematic(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Slow errors that neither noise nor warmer gears explain."""
    share = evidence.systematic
    if share is None:
        yield Finding(
            "systematic error",
            "doubtful",
            "without repetitions of one motion an error of the drive train (a coupling or torque"
            " constant) cannot be distinguished from noise, and was not looked for",
            "record the same motion several times",
        )
        return
    known, excused = np.nan_to_num(share), evidence.spoilt_by_friction(limit.systematic)
    wrong = np.flatnonzero((known > limit.systematic) & ~excused)
    if wrong.size:
        each = ", ".join(f"{share[j]:.1%} ({names[j]})" for j in wrong.tolist())
        yield Finding(
            "systematic error",
            "wrong",
            f"noise does not explain a torque error of {each} on {evidence.tested_on} (limit"
            f" {limit.systematic:.1%}): the model lacks something, or what is known of the arm is"
            " wrong",
            f"check sign, gear ratio, coupling and torque constant of {_all(names, wrong)}",
            "symptom",
        )
    small = np.flatnonzero((known > limit.noticeable) & (known <= limit.systematic))
    if small.size:
        each = ", ".join(f"{share[j]:.1%} of the torque of {names[j]}" for j in small.tolist())
        yield Finding(
            "systematic error",
            "doubtful",
            f"noise does not explain {each} on {evidence.tested_on}: the model lacks something"
            " small, or a constant is off",
            _constants(names, small, evidence),
            "symptom",
        )


def _constants(names: Sequence[str], joints: NDArray[np.intp], evidence: Evidence) -> str:
    """How to check torque constants: by a known weight, where gravity loads the joint."""
    loaded = evidence.loaded
    weighed = joints if loaded is None else joints[loaded[joints]]
    other = joints[:0] if loaded is None else joints[~loaded[joints]]
    steps = []
    if weighed.size:
        steps.append(
            f"check the torque constant of {_all(names, weighed)} with a known payload (`hil"
            " gains`)"
        )
    if other.size:
        steps.append(
            f"compare the torque constant of {_all(names, other)} with the drive's data sheet:"
            " gravity does not load it, so that no payload tells it"
        )
    return "; ".join(steps)


def _all(names: Sequence[str], joints: NDArray[np.intp]) -> str:
    return joined([names[j] for j in joints.tolist()], len(joints))


def consistent(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Repetitions that do not say the same."""
    share = evidence.disagreement
    if share is None or evidence.estimate.undetermined:
        return  # what a motion does not determine differs from repetition to repetition
    for axis, name in enumerate(names):
        if share[axis] > limit.inconsistency:
            yield Finding(
                "repetitions",
                "wrong",
                f"repetitions disagree: their estimates differ by up to {share[axis]:.0%} of the"
                f" torque of {name}, more than {limit.inconsistency:.0%}",
                "look at the repetitions one by one: something changed between them",
            )


def delay(names: Sequence[str], evidence: Evidence, limit: Thresholds) -> Iterator[Finding]:
    """Torque that lags the position by another time than the fit took it to, axis by axis."""
    surroundings = evidence.surroundings
    found = surroundings.delays
    if found is None:
        return
    assumed = np.broadcast_to(surroundings.assumed_delay, found.applied.shape)
    if found.significant and found.agree and np.array_equal(assumed, found.applied):
        yield Finding(
            "delay",
            "doubtful",
            f"the torque lags the position by {1e3 * found.common:.3g} ±"
            f" {1e3 * found.half_interval:.2g} ms ({1e3 * found.assumed:.3g} ms were stated); that"
            " was compensated",
            "state it (`hil identify --delay SECONDS`), or correct it where it arises",
            "condition",
        )
        return
    if not found.determined.any():
        return
    if evidence.estimate.undetermined or evidence.estimate.condition > limit.condition:
        return  # of a motion this poor a delay is another combination of parameters
    measured = [
        f"{name} {1e3 * found.delays[j]:.3g} ± {1e3 * found.interval_factor * found.std[j]:.2g} ms"
        f" ({1e3 * assumed[j]:.3g} ms assumed)"
        for j, name in enumerate(names)
    ]
    beyond = np.maximum(limit.delay * found.cycle, SIGMAS * found.std)
    off = np.flatnonzero(found.determined & (np.abs(found.delays - assumed) > beyond))
    if off.size:
        yield Finding(
            "delay",
            "doubtful",
            "the torque seems to lag the position by another time than was assumed: "
            + joined([measured[j] for j in off]),
            "compare with `hil identify --delay auto`, or correct the delay in the cell",
            "cause",
        )
    else:
        known = np.flatnonzero(found.determined)
        yield Finding(
            "delay",
            "good",
            "no delay stands out but the assumed one; the torque lags the position by: "
            + joined([measured[j] for j in known], 2),
        )
