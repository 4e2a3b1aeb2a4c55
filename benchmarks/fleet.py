"""A fleet of simulated arms with known faults, and how soon `hil trend` finds them.

Run with ``python -m benchmarks.fleet``. Torques are those of recursive Newton-Euler by pinocchio
with friction, temperature and noise of this module: nothing of `hil` or `identification`.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final, Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.signal import lfilter

Array = NDArray[np.float64]
FaultKind = Literal["wear", "lubricant", "replacement", "tool"]

FIRST: Final = datetime(2024, 1, 15, 8, tzinfo=UTC)
MONTH: Final = timedelta(days=30.44)
JOINTS: Final = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
_COULOMB: Final = np.array([12.0, 14.0, 8.0, 2.5, 2.5, 2.0])  # N·m
_VISCOUS: Final = np.array([16.0, 18.0, 10.0, 2.0, 2.0, 1.5])  # N·m·s/rad
_MIDDLE: Final = np.array([0.0, -1.2, 0.8, 0.0, 0.5, 0.0])  # rad
_ROTORS: Final = np.array([1.2, 1.2, 0.6, 0.2, 0.2, 0.2])  # kg·m²
_NOISE: Final = 0.02  # of the torque of a joint


@dataclass(frozen=True)
class Fault:
    """What happens to one joint of one robot.

    Attributes:
        robot: its number.
        kind: wear grows by `size` of the friction a month; a lost lubricant is a step of it, a
            replaced gear one downwards; a tool weighs `size` [kg] and is told to nobody.
        joint: its number; of no meaning for a tool.
        month: when it begins, counted from the first log.
        size: a share of friction, or kg.
    """

    robot: int
    kind: FaultKind
    joint: int
    month: float
    size: float

    def share(self, month: float) -> float:
        """Return the change of the joint's friction as a share of it."""
        if self.kind == "tool" or month < self.month:
            return 0.0
        return self.size * (month - self.month) if self.kind == "wear" else self.size

    @property
    def passes_tenth(self) -> float:
        """Month in which friction has changed by 10 %; of a tool that of its begin."""
        return self.month + 0.1 / self.size if self.kind == "wear" else self.month


@dataclass(frozen=True)
class FleetPlan:
    """A fleet and what happens to it.

    Attributes:
        robots: their number.
        months: a log of each robot in each.
        faults: of single robots.
        season: change of all friction between the coldest and the mean month, as a share.
        warm_up: change of all friction of a cold arm, as a share; how cold it is varies by log.
        day: standard deviation of the friction of a joint from log to log, as a share.
        spread: standard deviation of the friction of a joint between robots, as a share.
        duration: of a log [s].
        rate: of a log [Hz].
        seed: of all that is random.
    """

    robots: int = 20
    months: int = 24
    faults: tuple[Fault, ...] = ()
    season: float = 0.06
    warm_up: float = 0.08
    day: float = 0.01
    spread: float = 0.08
    duration: float = 30.0
    rate: float = 100.0
    seed: int = 0


@dataclass(frozen=True, eq=False)
class FleetLog:
    """One log: time (m,) [s], motion and torque (m, 6) in SI units, and what is known of it."""

    robot: int
    month: int
    when: datetime
    time: Array
    position: Array
    velocity: Array
    torque: Array
    temperature: float  #: of the joints [°C], as a controller measures it
    friction: Array  #: share of the nominal friction of each joint (6,)


def urdf() -> Path:
    """Return the UR10 of the package example-robot-data."""
    for file in importlib.metadata.files("example-robot-data") or ():
        if file.name == "ur10_robot.urdf":
            return Path(str(file.locate()))
    raise FileNotFoundError("ur10_robot.urdf")


@dataclass(eq=False)
class Fleet:
    """Simulates the logs of a plan; what is alike in all of them is computed once."""

    plan: FleetPlan
    _rigid: dict[float, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        plan = self.plan
        random = np.random.default_rng(plan.seed)
        self.time = np.arange(0.0, plan.duration, 1.0 / plan.rate)
        hertz = 0.1 + 0.12 * np.arange(5)[:, None] + random.uniform(0.0, 0.04, (5, 6))
        rate = 2.0 * np.pi * hertz
        size = random.uniform(0.2, 0.4, (5, 6)) / np.arange(1, 6)[:, None] ** 0.5
        angle = rate * self.time[:, None, None] + random.uniform(0.0, 6.0, (5, 6))
        self.position = (size * np.sin(angle)).sum(axis=1) + _MIDDLE
        self.velocity = (size * rate * np.cos(angle)).sum(axis=1)
        self.acceleration = -(size * rate**2 * np.sin(angle)).sum(axis=1)
        self.of_robot = 1.0 + plan.spread * random.standard_normal((plan.robots, 6))

    def log(self, robot: int, month: int) -> FleetLog:
        """Return the log of a robot in a month."""
        plan = self.plan
        random = np.random.default_rng([plan.seed, robot, month])
        faults = [fault for fault in plan.faults if fault.robot == robot]
        season = np.cos(2.0 * np.pi * month / 12.0)
        cold = random.uniform(0.0, 1.0)  # how much of the warm-up is still to come
        share = self.of_robot[robot] * (1.0 + plan.season * season + plan.warm_up * cold)
        share = share * (1.0 + plan.day * random.standard_normal(6))
        for fault in faults:
            share[fault.joint] *= 1.0 + fault.share(month)
        load = sum(f.size for f in faults if f.kind == "tool" and month >= f.month)
        torque = self._without_friction(load) + share * (
            _COULOMB * np.tanh(self.velocity / 1e-3) + _VISCOUS * self.velocity
        )
        white = random.standard_normal(torque.shape)
        coloured = lfilter([0.6], [1.0, -0.8], white, axis=0)
        return FleetLog(
            robot=robot,
            month=month,
            when=FIRST + month * MONTH + timedelta(hours=float(random.uniform(0.0, 8.0))),
            time=self.time,
            position=self.position + 2e-5 * random.standard_normal(torque.shape),
            velocity=self.velocity,
            torque=torque + _NOISE * torque.std(axis=0) * coloured,
            temperature=35.0 - 8.0 * season - 12.0 * cold + 0.3 * float(random.standard_normal()),
            friction=share,
        )

    def _without_friction(self, load: float) -> Array:
        """Return the torque of the arm with a load [kg] on its flange (m, 6)."""
        if load not in self._rigid:
            model = pin.buildModelFromUrdf(str(urdf()))
            body = pin.Inertia(load, np.array([0.0, 0.05, 0.1]), 0.01 * load * np.eye(3))
            model.appendBodyToJoint(model.njoints - 1, body, pin.SE3.Identity())
            data = model.createData()
            states = zip(self.position, self.velocity, self.acceleration, strict=True)
            rigid = np.array([pin.rnea(model, data, *state) for state in states])
            self._rigid[load] = rigid + _ROTORS * self.acceleration
        return self._rigid[load]


def write_log(path: Path, log: FleetLog, *, clock: bool = True, temperature: bool = True) -> Path:
    """Write a log as CSV; with `clock` its time counts from 1970, with `temperature` it has one."""
    start = log.when.timestamp() if clock else 0.0
    columns = [*(f"{name}{joint}" for name in ("q", "qd", "tau") for joint in range(1, 7))]
    times = [f"{start + time:.6f}" for time in log.time.tolist()]
    tables = np.column_stack([log.position, log.velocity, log.torque])
    ends = f",{log.temperature:.2f}" if temperature else ""
    rows = [
        f"{time},{','.join(f'{value:.9g}' for value in row)}{ends}"
        for time, row in zip(times, tables.tolist(), strict=True)
    ]
    header = ",".join(["timestamp", *columns, *(["temperature"] if temperature else [])])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def write_fleet(folder: Path, fleet: Fleet, *, months: Sequence[int] = ()) -> list[Path]:
    """Write the logs of a fleet as ``robot04/2024-06.csv``."""
    plan = fleet.plan
    logs = (fleet.log(r, m) for r in range(plan.robots) for m in months or range(plan.months))
    return [
        write_log(folder / f"robot{log.robot:02d}" / f"{log.when:%Y-%m-%d}.csv", log)
        for log in logs
    ]
