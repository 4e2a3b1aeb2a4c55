"""What `hil identify` says of one planted fault: the delay it applies, the cause and its size.

Run with ``python -m benchmarks.planted [--cases NAME ...] [--arms NAME ...] [--seeds N] [--json]``.
Arms, motions and noise come from `benchmarks.coverage` and share no code with what is tested;
each run fits a log of 30 s and predicts another motion, with default settings. The scale of each
torque is off by 3 % (standard deviation).

Cases are a delay of all torques (0, 1.3 and 4 ms), the same beside friction that the assumed law
does not have (Stribeck friction, a drift), and faults that resemble a delay and have none: friction
that rises by 30 % in the fitted log or between the logs, an encoder zero off by 0.05 rad. The
torque of one joint times 1.5, in all data or in the second log, tests the factor that is printed.

A line per run: true and applied delay with its 95 % interval, whether the interval holds the truth
and whether it contains the stated delay (none), the causes named, and the printed factor of the
joint's torque over the true one. The last lines count:

- ``near``: the applied delay is within 0.3 ms of the true one, ``false``: applied where there is
  none, ``missed``: none applied where there is one, ``doubtful``: applied although the interval
  contains the stated delay, ``held``: the interval, where one is stated, holds the true delay;
- ``named``: a factor was printed for the right joint, ``factor_held``: its interval holds the
  planted one, which is 1.5 times the scale of that torque.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show
from benchmarks.arms import ARMS, urdf
from benchmarks.board import suspicious
from benchmarks.coverage import (
    ARM_TYPES,
    DEFAULTS,
    FITTED_TIME,
    HELD_OUT_TIME,
    NEAR,
    Arm,
    ArmType,
    Logged,
    drawn_arm,
    drawn_motion,
    logged,
    torque_scale,
)
from benchmarks.degradations import CAUSES
from benchmarks.joint_log import JointLog
from hil.base.progress import Silent
from hil.importers.imported_robot import Robot
from hil.pipeline.identification import Identification, identify_archives

Array = NDArray[np.float64]

PLANTED_ARMS: Final[Mapping[str, ArmType]] = {
    **ARM_TYPES,
    "ur10": ArmType(
        urdf=ARMS["ur10"],
        rotor=(4.0, 4.0, 1.5, 0.4, 0.4, 0.4),
        coulomb=(15.0, 15.0, 8.0, 2.5, 2.5, 2.5),
        viscous=(20.0, 20.0, 10.0, 3.0, 3.0, 3.0),
        rated_payload=10.0,
    ),
}
"""The arms of `benchmarks.coverage`, and one of medium friction."""

_STATED: Final = 0.0  # s, delay of an imported log
_STRIBECK_SPEED: Final = 0.1  # rad/s
_JOINT: Final = 2  # from 0, of the encoder or motor at fault
_FITTED: Final = 0  # part


class Plant(NamedTuple):
    """One fault of a log.

    Attributes:
        delay: of all torques [s].
        stribeck: friction beside Coulomb's at rest, as a share of it, falling as
            ``exp(-|v| / 0.1)``.
        drift: share by which friction grows from the first to the last row of the fitted log,
            linearly, and about the drawn one; the other log has that of the end.
        friction_later: share by which friction is larger from the middle of the fitted log on.
        friction_second: the same, of the other log.
        zero: error of one joint's encoder [rad].
        gain: factor of one joint's torque in both logs.
        gain_second: the same, of the other log.
    """

    delay: float = 0.0
    stribeck: float = 0.0
    drift: float = 0.0
    friction_later: float = 0.0
    friction_second: float = 0.0
    zero: float = 0.0
    gain: float = 1.0
    gain_second: float = 1.0


CASES: Final[Mapping[str, Plant]] = {
    "nothing": Plant(),
    "1.3 ms": Plant(delay=1.3e-3),
    "4 ms": Plant(delay=4e-3),
    "1.3 ms, Stribeck": Plant(delay=1.3e-3, stribeck=0.4),
    "1.3 ms, drift": Plant(delay=1.3e-3, drift=0.1),
    "friction +30 % later": Plant(friction_later=0.3),
    "friction +30 % second": Plant(friction_second=0.3),
    "encoder zero": Plant(zero=0.05),
    "constant 1.5": Plant(gain=1.5),
    "constant 1.5 second": Plant(gain_second=1.5),
}


def planted(arm: Arm, plant: Plant, seed: int, part: int, duration: float) -> Logged:
    """Log a motion with a fault."""
    log = logged(arm, seed, part, duration, plant.delay, DEFAULTS)
    motion = drawn_motion(
        arm.robot, np.random.default_rng([seed, 2, part]), duration, DEFAULTS.speed
    )
    at = log.time - plant.delay
    velocity = motion.at(at)[1]
    friction = arm.friction.torque(velocity, np.zeros_like(velocity)) - arm.friction.offset
    more = plant.drift * (np.clip(at / duration, 0.0, 1.0) - 0.5)
    more += plant.friction_later * (at >= 0.5 * duration)
    if part != _FITTED:
        more = np.full(len(at), 0.5 * plant.drift + plant.friction_second)
    slow = plant.stribeck * arm.friction.coulomb * np.exp(-np.abs(velocity) / _STRIBECK_SPEED)
    torque = log.torque + more[:, None] * friction + slow * np.tanh(velocity / 1e-3)
    torque[:, _JOINT] *= plant.gain if part == _FITTED else plant.gain * plant.gain_second
    position = log.position.copy()
    position[:, _JOINT] += plant.zero
    return Logged(log.time, position, torque)


class Outcome(NamedTuple):
    """What was said of one run.

    Attributes:
        applied: delay in the fit [s].
        half: half its 95 % interval [s], None where none is stated.
        blamed: names of findings that blame something.
        factor: printed for the torque of the joint at fault, None if it is not.
        factor_half: half its 95 % interval.
        good: whether the verdict is.
        error: of held-out torque.
        true_factor: of the torque of the joint at fault.
        seconds: of the processor.
    """

    applied: float
    half: float | None
    blamed: tuple[str, ...]
    factor: float | None
    factor_half: float | None
    good: bool
    error: float
    true_factor: float
    seconds: float


def run(name: str, plant: Plant, seed: int) -> Outcome:
    """Simulate an arm, log it with the fault, import the logs and identify the first."""
    kind = PLANTED_ARMS[name]
    arm = drawn_arm(kind, seed)
    with tempfile.TemporaryDirectory() as scratch:
        robot = Robot.from_urdf(urdf(kind.urdf), locked=kind.locked)
        archives = []
        for part, duration in enumerate((FITTED_TIME, HELD_OUT_TIME)):
            log = planted(arm, plant, seed, part, duration)
            joint_log = JointLog(
                robot, log.time, log.position, None, log.torque, kind.rated_payload
            )
            archives.append(joint_log.imported(Path(scratch) / f"{part}.mcap"))
        start = time.process_time()
        found = identify_archives(archives[:1], Silent(), predict=archives[1:])
        seconds = time.process_time() - start
    factor = plant.gain_second
    if plant.gain != 1.0:
        factor = plant.gain * float(torque_scale(seed, arm.robot.nv, DEFAULTS)[_JOINT])
    return outcome_of(found, factor, seconds)


def outcome_of(found: Identification, true_factor: float, seconds: float) -> Outcome:
    """Read the delay and the causes."""
    results = found.results
    delays = results.delays
    halves = [] if delays is None else [half for half in delays.interval if half is not None]
    checks = [finding.check for finding in suspicious(results) if finding.check in CAUSES]
    sizes = [
        (1.0 + each.size, each.half_interval)
        for each in found.validation.evidence.explanations or ()
        if each.change[:2] == ("scale", (_JOINT,))
        and not each.change.part
        and each.size is not None
    ]
    sizes += [
        (change.ratio, 2.0 * change.std)
        for change in found.validation.evidence.changes
        if change.kind == "gain" and change.joint == _JOINT
    ]
    factor, half = sizes[0] if sizes else (None, None)
    return Outcome(
        applied=results.delays.applied[0] if results.delays else _STATED,
        half=halves[0] if halves else None,
        blamed=tuple(dict.fromkeys(checks)),
        factor=factor,
        factor_half=half,
        good=results.verdict.good,
        error=results.validation[0].all_rows_relative_error,
        true_factor=true_factor,
        seconds=seconds,
    )


def figures(outcomes: Sequence[tuple[Plant, Outcome]]) -> dict[str, int]:
    """Summarise some runs; see the module for the figures."""
    wrong = [out.applied - plant.delay for plant, out in outcomes]
    used = [abs(out.applied - _STATED) > 0.0 for _, out in outcomes]
    there = [plant.delay != _STATED for plant, _ in outcomes]
    factors = [out for _, out in outcomes if out.factor is not None]
    return {
        "runs": len(outcomes),
        "near": sum(abs(error) <= NEAR for error in wrong),
        "false": sum(use and not real for use, real in zip(used, there, strict=True)),
        "missed": sum(real and not use for use, real in zip(used, there, strict=True)),
        "doubtful": sum(
            use and out.half is not None and abs(out.applied - _STATED) <= out.half
            for use, (_, out) in zip(used, outcomes, strict=True)
        ),
        "intervals": sum(out.half is not None for _, out in outcomes),
        "held": sum(
            out.half is not None and abs(error) <= out.half
            for error, (_, out) in zip(wrong, outcomes, strict=True)
        ),
        "named": len(factors),
        "factor_held": sum(
            abs((out.factor or 0.0) - out.true_factor) <= (out.factor_half or 0.0)
            for out in factors
        ),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    """Plant, identify, print a line per run and per case, then the line of JSON."""
    parser = parser_of(__doc__)
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--arms", nargs="+", choices=list(PLANTED_ARMS), default=list(PLANTED_ARMS))
    parser.add_argument("--seeds", type=int, default=2, help="runs per arm and case")
    parser.add_argument("--first-seed", type=int, default=1)
    options = parser.parse_args(arguments)
    seeds = range(options.first_seed, options.first_seed + options.seeds)
    every: list[tuple[Plant, Outcome]] = []
    rows: dict[str, Any] = {}
    for case in options.cases:
        plant = CASES[case]
        outcomes = []
        for name in options.arms:
            for seed in seeds:
                outcome = run(name, plant, seed)
                outcomes.append((plant, outcome))
                line = f"{case:22} {name:6} {seed}  {_line(plant, outcome)}"
                print(line, file=sys.stderr, flush=True)
        rows[case] = figures(outcomes)
        every += outcomes
        if not options.json:
            print(f"{case:22} {rows[case]}", flush=True)
    show({**rows, "all": figures(every)}, only_json=True)


def _line(plant: Plant, out: Outcome) -> str:
    half = "" if out.half is None else f" ± {1e3 * out.half:.2f}"
    shown = [f"delay {1e3 * plant.delay:.1f}: applied {1e3 * out.applied:.2f}{half} ms"]
    if out.factor is not None:
        shown.append(f"factor {out.true_factor:.3f}: {out.factor:.3f} ± {out.factor_half:.3f}")
    shown.append(f"blamed {', '.join(out.blamed) or 'nothing'}")
    shown.append(f"good {out.good}  error {out.error:.4f}  {out.seconds:.1f} s")
    return "  ".join(shown)


if __name__ == "__main__":
    main()
