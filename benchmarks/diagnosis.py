"""Logs of simulated arms with one to three planted faults, and what `hil look` says of them.

Run with ``python -m benchmarks.diagnosis [--logs N] [--first-seed N] [--json]``. Arms, motions and
noise come from `benchmarks.coverage` and share no code with what is tested. A log of 20 s has one
to three of: zeros of one to three joints off by 6 to 40 degrees, torques of one or two joints
recorded 1.3 to 2.5 times too large or small, a joint with the sign of its torque, its position or
both negated. Zeros and signs are of joints whose torque is at least half that of bodies, scales of
those as well: of others the torque shows nothing.

*whole*: each fault is named, zeros to 5 degrees and scales to a quarter, whatever the certainty;
*wrong*: a row that is called certain says of a joint what was not planted.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks import parser_of, show
from benchmarks.arms import urdf
from benchmarks.coverage import DEFAULTS, ArmType, drawn_arm, logged
from benchmarks.planted import PLANTED_ARMS
from hil.importers.conclusions import Certainty
from hil.importers.imported_robot import Robot
from hil.importers.recording_import import ImportOptions
from hil.look import Look, look_at
from hil.look.readings import ArmChange, Changes
from identification.hypotheses.joint_changes import SIGNS, Change

Array = NDArray[np.float64]

_DURATION: Final = 20.0  # s
_OF_BODIES: Final = 0.5  # share of a torque that is of bodies, of a joint that shows a fault
_NEAR_ZERO: Final = np.radians(5.0)
_NEAR_SCALE: Final = np.log(1.25)


class Case(NamedTuple):
    """A log with its faults, as the changes that undo them."""

    arm: ArmType
    time: Array
    position: Array
    torque: Array
    faults: tuple[Change, ...]


def planted(seed: int) -> Case:
    """Return a log with drawn faults."""
    random = np.random.default_rng([seed, 77])
    kind = list(PLANTED_ARMS.values())[seed % len(PLANTED_ARMS)]
    arm = drawn_arm(kind, seed)
    log = logged(arm, seed, 0, _DURATION, 0.0, DEFAULTS)
    faults = drawn_faults(random, seen_joints(log.time, log.position, log.torque, arm))
    sign = np.ones(log.position.shape[1])
    torque = log.torque.copy()
    for fault in faults:
        (joint,) = fault.joints
        if fault.meaning == "scale":
            torque[:, joint] *= 1.0 + fault.size
        if fault.meaning in ("position sign", "axis sign"):
            sign[joint] = -1.0
        if fault.meaning in ("torque sign", "axis sign"):
            torque[:, joint] *= -1.0
    zero = np.zeros(len(sign))
    for fault in faults:
        if fault.meaning == "zero":
            zero[list(fault.joints)] = fault.size
    return Case(kind, log.time, sign * (log.position - zero), torque, faults)


def seen_joints(time_: Array, position: Array, torque: Array, arm: object) -> list[int]:
    """Return the joints between the first and the last whose torque is mostly of bodies."""
    velocity = np.gradient(position, time_, axis=0)
    velocity = np.where(np.abs(velocity) > 1e-3, velocity, 0.0)
    friction = arm.friction.torque(velocity, np.zeros_like(velocity), 1.0)  # type: ignore[attr-defined]
    share = 1.0 - friction.std(axis=0) / torque.std(axis=0)
    joints = [j for j in range(1, position.shape[1] - 1) if share[j] > _OF_BODIES]
    return joints or [1]


def drawn_faults(random: np.random.Generator, joints: list[int]) -> tuple[Change, ...]:
    """Return one to three kinds of faults of joints, one sign at most."""
    faults = []
    kinds = random.choice(["zeros", "scales", "sign"], size=random.integers(1, 4), replace=False)
    for kind in kinds:
        most = {"zeros": 3, "scales": 2, "sign": 1}[str(kind)]
        count = min(len(joints), int(random.integers(1, most + 1)))
        for joint in random.choice(joints, size=count, replace=False).tolist():
            if kind == "zeros":
                size = np.radians(random.uniform(6.0, 40.0)) * random.choice([-1.0, 1.0])
                faults.append(Change("zero", (joint,), float(size)))
            elif kind == "scales":
                factor = random.uniform(1.3, 2.5) ** random.choice([-1.0, 1.0])
                faults.append(Change("scale", (joint,), float(factor) - 1.0))
            else:
                faults.append(Change(SIGNS[int(random.integers(len(SIGNS)))], (joint,)))
    return tuple(faults)


def is_named(fault: Change, change: Change) -> bool:
    """Return whether a change is that of a fault, to its tolerance."""
    if (fault.meaning, fault.joints) != (change.meaning, change.joints):
        return False
    if fault.meaning == "zero":
        return bool(abs(fault.size - change.size) < _NEAR_ZERO)
    if fault.meaning == "scale":
        return bool(abs(np.log((1.0 + fault.size) / (1.0 + change.size))) < _NEAR_SCALE)
    return True


def said(look: Look) -> Iterator[tuple[Change, bool]]:
    """Yield each change of a look, and whether it is certain."""
    for row in look.rows:
        changes = row.reading.changes if isinstance(row.reading, Changes) else ()
        for each in changes:
            yield each.change, row.certainty is Certainty.CERTAIN
    for choices in look.questions:
        for choice in choices:
            if isinstance(choice.reading, ArmChange):
                yield choice.reading.change, False


def judged(seed: int, folder: Path) -> dict[str, object]:
    """Return the outcome of a look at one log."""
    case = planted(seed)
    path = folder / "log.npz"
    np.savez(path, t=case.time, q=case.position, tau=case.torque)
    robot = Robot.from_urdf(urdf(case.arm.urdf), locked=case.arm.locked)
    begin = time.process_time()
    found = list(said(look_at(path, lambda _: robot, ImportOptions(outside_limits=True))))
    whole = all(any(is_named(fault, change) for change, _ in found) for fault in case.faults)
    wrong = [
        change
        for change, is_certain in found
        if is_certain and not any(is_named(fault, change) for fault in case.faults)
    ]
    return {
        "seed": seed,
        "whole": whole,
        "wrong": [str(change) for change in wrong],
        "seconds": round(time.process_time() - begin, 1),
        "planted": [f"{each.meaning} {each.joints} {each.size:.2f}" for each in case.faults],
        "said": [f"{each.meaning} {each.joints} {each.size:.2f} {sure}" for each, sure in found],
    }


def main() -> None:
    """Print a line for each log, and the shares."""
    parser = parser_of(__doc__)
    parser.add_argument("--logs", type=int, default=100)
    parser.add_argument("--first-seed", type=int, default=0)
    options = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(options.first_seed, options.first_seed + options.logs):
            rows.append(judged(seed, Path(folder)))
            if not options.json:
                print(*rows[-1].values(), flush=True)
    whole = sum(bool(row["whole"]) for row in rows)
    wrong = sum(bool(row["wrong"]) for row in rows)
    show({"logs": len(rows), "whole": whole, "wrong": wrong}, only_json=options.json)


if __name__ == "__main__":
    main()
