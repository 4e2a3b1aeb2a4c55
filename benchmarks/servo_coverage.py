"""Whether 95 % intervals of servos identified without torque hold the truth of simulated arms.

Run with ``python -m benchmarks.servo_coverage [--seeds N] [--first SEED] [--seconds S] [--json]``.
Each seed is an arm of its own (`benchmarks.servo_arm`: gains, friction, static and load-dependent,
torque limit, dead band, delay of the bus; joints move all at once by pinocchio's dynamics,
at another step and with another integrator than what is fitted), a motion and encoder counts.

- ``covered``: share of the 95 % intervals that hold the true value, of parameters that are called
  determined, and of all that the model has; by parameter.
- ``determined``: share of parameters that are called determined.
- ``wrong``: parameters called determined whose value is off by more than a factor of 2, or whose
  interval misses the truth by more than its own width.
- ``error``: root mean square of a motion that was not fitted, simulated from its commands alone,
  over that of the command itself; median over the seeds.
- ``contacts``: ten poses without a floor, and with one at the height above which the arm's end was
  in 70 % of the time. Share of the time on the floor, and of the arms on it, in which a contact is
  found; and the number of contacts found where there is none, in all motions.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks import servo_arm as planted
from identification import RobotModel
from identification.servo.choice import fit_servos
from identification.servo.contacts import Contact, contacts_of
from identification.servo.intervals import intervals_of
from identification.servo.parameters import PLACE
from identification.servo.prediction import predicted
from identification.servo.recorded_motion import Grid, ServoMotion, motions_of
from identification.signals.recording import Recording

Array = NDArray[np.float64]
PLANTED: Final = (
    *("kp", "kd", "armature", "viscous", "coulomb", "static", "speed"),
    *("load", "limit", "dead_band", "delay"),
)
_WRONG_FACTOR: Final = 2.0
_POSES: Final = 40.0  # s
_FLOOR: Final = 0.3  # quantile of the heights of the arm's end
_TOUCHING: Final = 1e-3  # m above the floor, of positions in encoder counts


@dataclass(frozen=True)
class Judged:
    """One interval."""

    seed: int
    name: str
    joint: int
    true: float
    value: float
    lower: float
    upper: float
    present: bool
    determined: bool

    @property
    def covers(self) -> bool:
        """Whether the interval holds the truth."""
        return self.lower <= self.true <= self.upper

    @property
    def wrong(self) -> bool:
        """Whether it is called determined, and is not."""
        ratio = max(self.value, 1e-12) / max(self.true, 1e-12)
        far = not 1.0 / _WRONG_FACTOR <= ratio <= _WRONG_FACTOR
        width = self.upper - self.lower
        missed = max(self.lower - self.true, self.true - self.upper) > width
        return self.determined and (far or missed)


@dataclass(frozen=True)
class Touched:
    """What is found of a floor, and where there is none [s]."""

    touched: float
    found: float
    false: int  #: contacts


@dataclass(frozen=True)
class Arm:
    """What is judged of an arm.

    Attributes:
        rows: its intervals.
        error: of an unseen motion over its command's.
        touched: contacts.
    """

    rows: list[Judged]
    error: float
    touched: Touched


def judged(seed: int, seconds: float) -> Arm:
    """Return what is judged of an arm."""
    rng = np.random.default_rng(seed)
    truth = planted.Planted.drawn(rng)
    model, bodies = _model()
    recordings = []
    for duration in (seconds, 12.0):
        instants, command = planted.commands(rng, duration)
        recordings.append(
            Recording(
                time=instants,
                position=planted.simulated(truth, instants, command),
                joint_names=planted.NAMES,
                commanded_position=command,
            )
        )
    fitted, other = recordings
    grid = Grid.of(fitted)
    resolution = np.full(3, planted.COUNT / np.sqrt(12.0))
    found = fit_servos(lambda on: motions_of(fitted, model, bodies, on), grid, resolution)
    (unseen,) = motions_of(other, model, bodies, grid)
    intervals = intervals_of(found)
    (simulated,) = predicted(model, bodies, unseen, [intervals.values])
    error = np.sqrt(np.mean((simulated - unseen.position) ** 2))
    command_error = np.sqrt(np.mean((unseen.command - unseen.position) ** 2))
    rows = [
        Judged(
            seed,
            name,
            joint,
            true=float(np.broadcast_to(getattr(truth, name), 3)[joint]),
            value=float(intervals.values[joint, PLACE[name]]),
            lower=float(intervals.lower[joint, PLACE[name]]),
            upper=float(intervals.upper[joint, PLACE[name]]),
            present=bool(found.estimate.present[joint, PLACE[name]]),
            determined=bool(intervals.determined[joint, PLACE[name]]),
        )
        for name in PLANTED
        for joint in range(3)
    ]
    instants, command = planted.poses(rng, _POSES)
    free = planted.simulated(truth, instants, command)
    floor = float(np.quantile(planted.tip_heights(free), _FLOOR))
    on_floor = planted.simulated(truth, instants, command, floor)
    poses = [replace(other, time=instants, position=positions, commanded_position=command)
             for positions in (free, on_floor)]  # fmt: skip
    *untouched, touching = [
        motion
        for each in (fitted, other, *poses)
        for motion in motions_of(each, model, bodies, grid)
    ]
    false = sum(len(contacts_of(motion, found, resolution)) for motion in untouched)
    on = planted.tip_heights(touching.position) < floor + _TOUCHING
    touched = _touched(touching, on, contacts_of(touching, found, resolution))
    touched = replace(touched, false=touched.false + false)
    return Arm(rows, float(error / command_error), touched)


def _touched(motion: ServoMotion, on: NDArray[np.bool_], contacts: Sequence[Contact]) -> Touched:
    """Return what contacts say of a motion, in some of whose instants (g,) there is one."""
    instants = motion.step * np.arange(len(on))
    marked = np.zeros(len(on), np.bool_)
    false = 0
    for contact in contacts:
        rows = (instants >= contact.start) & (instants <= contact.end)
        marked |= rows
        false += not (rows & on).any()
    return Touched(float(motion.step * on.sum()), float(motion.step * (marked & on).sum()), false)


def _model() -> tuple[RobotModel, Array]:
    model = RobotModel.from_urdf(planted.urdf())
    standard = model.nominal.copy()
    standard[model.layout.rotors] = 0.0
    bodies = np.zeros(model.n_parameters)
    bodies[: model.base.rank] = model.base.grouping @ standard
    return model, bodies


def figures(arms: Sequence[Arm]) -> dict[str, Any]:
    """Return the figures of all seeds."""
    rows = [row for arm in arms for row in arm.rows]
    touched = [arm.touched for arm in arms]

    def share(chosen: Iterable[float]) -> float | None:
        values = list(chosen)
        return round(float(np.mean(values)), 3) if values else None

    by_name: dict[str, list[Judged]] = defaultdict(list)
    for row in rows:
        by_name[row.name].append(row)
    return {
        "covered_determined": share(row.covers for row in rows if row.determined),
        "covered": share(row.covers for row in rows if row.present),
        "determined": share(row.determined for row in rows),
        "wrong": [
            f"{row.name} of {planted.NAMES[row.joint]}, seed {row.seed}: {row.value:.3g}"
            f" ({row.lower:.3g} to {row.upper:.3g}), true {row.true:.3g}"
            for row in rows
            if row.wrong
        ],
        "error": round(float(np.median([arm.error for arm in arms])), 4),
        "contacts": {
            "time": share([sum(t.found for t in touched) / sum(t.touched for t in touched)]),
            "arms": share(each.found > 0.0 for each in touched if each.touched > 0.0),
            "false": sum(each.false for each in touched),
        },
        "by_parameter": {
            name: {
                "covered_determined": share(row.covers for row in group if row.determined),
                "covered": share(row.covers for row in group if row.present),
                "determined": share(row.determined for row in group),
            }
            for name, group in by_name.items()
        },
    }


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    parser.add_argument("--first", type=int, default=1)
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    arms: list[Arm] = []
    started = time.process_time()
    for seed in range(options.first, options.first + options.seeds):
        arm = judged(seed, options.seconds)
        arms.append(arm)
        if not options.json:
            known = [row for row in arm.rows if row.determined]
            held = sum(row.covers for row in known)
            for row in known:
                if not row.covers:
                    print(
                        f"  missed: {row.name} of {planted.NAMES[row.joint]} {row.value:.4g}"
                        f" ({row.lower:.4g} to {row.upper:.4g}), true {row.true:.4g}"
                    )
            print(
                f"seed {seed}: {held} of {len(known)} determined held, error {arm.error:.3f};"
                f" on a floor for {arm.touched.touched:.1f} s, {arm.touched.found:.1f} found,"
                f" {arm.touched.false} contacts elsewhere",
                flush=True,
            )
    result = figures(arms)
    result["processor_seconds"] = round((time.process_time() - started) / options.seeds, 1)
    if options.json:
        print(json.dumps(result, indent=1))
        return
    for name, value in result.items():
        if name == "by_parameter":
            for parameter, group in value.items():
                print(f"  {parameter:10} {group}")
        elif name == "wrong":
            print("wrong:", *value, sep="\n  ")
        else:
            print(f"{name}: {value}")


if __name__ == "__main__":
    main()
