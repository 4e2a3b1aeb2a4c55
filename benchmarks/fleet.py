"""A fleet of simulated arms with known faults, and how soon `hil trend` finds them.

Run with ``python -m benchmarks.fleet [--fleets N] [--logged WHAT]``: fleets of 20 robots over 24
months, which are asked about every month, as a nightly job does. The friction of each joint, and
the gravity load of joints that bear the arm's weight, are known from each log to half a per cent,
as from 30 s of motion; what follows is the trend.
`write_fleet` simulates logs by pinocchio's recursive Newton-Euler with this module's friction,
temperature and noise; it uses nothing of `hil` or `identification`.
"""

from __future__ import annotations

import argparse
import importlib.metadata
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from pathlib import Path
from time import process_time
from typing import Final, Literal, NamedTuple, get_args

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray
from scipy.signal import lfilter

from hil.compare.comparison import FALSE_ALARM_RATE, MIN_RELATIVE_CHANGE, holm
from hil.fleet.covariates import warmed
from hil.fleet.series_changes import Course, Series, common_course, courses

Array = NDArray[np.float64]
FaultKind = Literal["wear", "lubricant", "replacement", "tool"]
Known = Literal["temperature", "minutes since start", "nothing"]
Followed = Literal["friction", "gravity load"]

EVERY: Final = -1
"""Number in place of that of a robot: what happens to all of them."""
FIRST: Final = datetime(2024, 1, 15, 8, tzinfo=UTC)
MONTH: Final = timedelta(days=30.44)
JOINTS: Final = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
_COULOMB: Final = np.array([12.0, 14.0, 8.0, 2.5, 2.5, 2.0])  # N·m
_VISCOUS: Final = np.array([16.0, 18.0, 10.0, 2.0, 2.0, 1.5])  # N·m·s/rad
_MIDDLE: Final = np.array([0.0, -1.2, 0.8, 0.0, 0.5, 0.0])  # rad
_ROTORS: Final = np.array([1.2, 1.2, 0.6, 0.2, 0.2, 0.2])  # kg·m²
_NOISE: Final = 0.02  # of the torque of a joint
_WARM_UP: Final = 45.0  # minutes, its time constant


@dataclass(frozen=True)
class Fault:
    """What happens to one joint of one robot.

    Attributes:
        robot: its number, or `EVERY`.
        kind: wear grows by `size` of the friction a month; a lost lubricant is a step of it, a
            replaced gear one downwards; a tool weighs `size` [kg], which no log states.
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

    @property
    def quantity(self) -> Followed:
        """What a trend sees of it."""
        return "gravity load" if self.kind == "tool" else "friction"


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


class Condition(NamedTuple):
    """What a robot is like on a day."""

    when: datetime
    temperature: float  #: of the joints [°C], as a controller measures it
    minutes: float  #: since the robot was started
    friction: Array  #: share of the nominal friction of each joint (6,)


@dataclass(frozen=True, eq=False)
class FleetLog:
    """One log: time (m,) [s], motion and torque (m, 6) in SI units, and what is known of it."""

    robot: int
    month: int
    condition: Condition
    time: Array
    position: Array
    velocity: Array
    torque: Array


def urdf() -> Path:
    """Return the UR10 of the package example-robot-data."""
    for file in importlib.metadata.files("example-robot-data") or ():
        if file.name == "ur10_robot.urdf":
            return Path(str(file.locate()))
    raise FileNotFoundError("ur10_robot.urdf")


def loaded_arm(load: float) -> pin.Model:
    """Return the arm with a load [kg] on its flange."""
    model = pin.buildModelFromUrdf(str(urdf()))
    body = pin.Inertia(load, np.array([0.0, 0.05, 0.1]), 0.01 * load * np.eye(3))
    model.appendBodyToJoint(model.njoints - 1, body, pin.SE3.Identity())
    return model


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

    def condition(self, robot: int, month: int) -> Condition:
        """Return date, temperature and friction of a robot when its log of a month begins."""
        plan = self.plan
        random = np.random.default_rng([plan.seed, robot, month])
        season = np.cos(2.0 * np.pi * month / 12.0)
        cold = float(random.uniform(0.0, 1.0))  # how much of the warm-up is still to come
        share = self.of_robot[robot] * (1.0 + plan.season * season + plan.warm_up * cold)
        share = share * (1.0 + plan.day * random.standard_normal(6))
        for fault in plan.faults:
            if fault.robot in (robot, EVERY):
                share[fault.joint] *= 1.0 + fault.share(month)
        return Condition(
            when=FIRST + month * MONTH + timedelta(hours=float(random.uniform(0.0, 8.0))),
            minutes=-_WARM_UP * float(np.log(cold)),
            temperature=35.0 - 8.0 * season - 12.0 * cold + 0.3 * float(random.standard_normal()),
            friction=share,
        )

    def log(self, robot: int, month: int) -> FleetLog:
        """Return the log of a robot in a month."""
        plan = self.plan
        condition = self.condition(robot, month)
        random = np.random.default_rng([plan.seed, robot, month, 1])
        carried = [f for f in plan.faults if f.robot == robot and f.kind == "tool"]
        load = sum(fault.size for fault in carried if month >= fault.month)
        dry = _COULOMB * np.tanh(self.velocity / 1e-3)
        friction = condition.friction * (dry + _VISCOUS * self.velocity)
        torque = self._without_friction(load) + friction
        coloured = lfilter([0.6], [1.0, -0.8], random.standard_normal(torque.shape), axis=0)
        return FleetLog(
            robot=robot,
            month=month,
            condition=condition,
            time=self.time,
            position=self.position + 2e-5 * random.standard_normal(torque.shape),
            velocity=self.velocity,
            torque=torque + _NOISE * torque.std(axis=0) * coloured,
        )

    def _without_friction(self, load: float) -> Array:
        """Return the torque of the arm with a load [kg] on its flange (m, 6)."""
        if load not in self._rigid:
            model = loaded_arm(load)
            data = model.createData()
            states = zip(self.position, self.velocity, self.acceleration, strict=True)
            rigid = np.array([pin.rnea(model, data, *state) for state in states])
            self._rigid[load] = rigid + _ROTORS * self.acceleration
        return self._rigid[load]

    def gravity_shares(self, load: float, joints: Sequence[int]) -> Array:
        """Return by what share a load [kg] on the flange changes the gravity of joints (k,)."""
        bare, loaded = (self._gravity(each)[:, joints] for each in (0.0, load))
        shares: Array = np.einsum("mj,mj->j", bare, loaded) / np.einsum("mj,mj->j", bare, bare)
        return shares - 1.0

    def _gravity(self, load: float) -> Array:
        model = loaded_arm(load)
        data = model.createData()
        return np.array([pin.computeGeneralizedGravity(model, data, q) for q in self.position])


def write_log(path: Path, log: FleetLog, *, clock: bool = True, temperature: bool = True) -> Path:
    """Write a log as CSV; with `clock` its time counts from 1970, with `temperature` it has one."""
    start = log.condition.when.timestamp() if clock else 0.0
    columns = [*(f"{name}{joint}" for name in ("q", "qd", "tau") for joint in range(1, 7))]
    times = [f"{start + time:.6f}" for time in log.time.tolist()]
    tables = np.column_stack([log.position, log.velocity, log.torque])
    ends = f",{log.condition.temperature:.2f}" if temperature else ""
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
        write_log(folder / f"robot{log.robot:02d}" / f"{log.condition.when:%Y-%m-%d}.csv", log)
        for log in logs
    ]


# The benchmark

_MEASURED: Final = 0.005  # standard deviation of a quantity from one log
_BEARING: Final = (1, 2)  # joints whose gravity load is followed: the shoulder and the elbow
_FIRST_ASKED: Final = 6  # months of logs
_MOST_FAULTS: Final = 3
_IN_TIME: Final = 2.0  # months from 10 % to an alarm


class Outcome(NamedTuple):
    """What was said of one fleet over all months."""

    found: list[tuple[Fault, int | None, float]]  #: month of the alarm; error of its begin at last
    alarms: int  #: places without a fault that were called changed at any time
    years: float


class Place(NamedTuple):
    """Where a change is found."""

    robot: int  #: its number, or `EVERY`
    quantity: Followed
    joint: int


def planned(seed: int, *, faulty: bool) -> FleetPlan:
    """Return a fleet with one to three faults of different robots, or with none.

    Every second fleet with faults also changes as a whole, when a year has passed.
    """
    random = np.random.default_rng(seed)
    faults = []
    robots = random.permutation(20)
    kinds = get_args(FaultKind)
    for robot in robots[: random.integers(1, _MOST_FAULTS + 1)] if faulty else ():
        kind = kinds[random.integers(len(kinds))]
        size = {
            "wear": random.uniform(0.02, 0.08),
            "lubricant": random.uniform(0.12, 0.4),
            "replacement": -random.uniform(0.12, 0.3),
            "tool": random.uniform(0.5, 3.0),
        }[kind]
        month = float(random.uniform(6.0, 15.0))
        faults.append(Fault(int(robot), kind, int(random.integers(6)), month, float(size)))
    if faulty and seed % 2:
        month, size = random.uniform(12.0, 19.0), random.uniform(0.1, 0.3)
        faults.append(Fault(EVERY, "lubricant", int(random.integers(6)), month, size))
    return FleetPlan(faults=tuple(faults), seed=seed)


def watched(plan: FleetPlan, known: Known = "temperature") -> Outcome:
    """Ask about a fleet every month, with what its logs say of their warm-up."""
    fleet = Fleet(plan)
    random = np.random.default_rng(plan.seed)
    conditions = [[fleet.condition(r, m) for m in range(plan.months)] for r in range(plan.robots)]
    values: dict[Followed, Array] = {
        "friction": np.array([[each.friction for each in robot] for robot in conditions]),
        "gravity load": np.ones((plan.robots, plan.months, 6)),
    }
    for fault in plan.faults:
        if fault.kind == "tool":
            begun = np.arange(plan.months) >= fault.month
            shares = fleet.gravity_shares(fault.size, _BEARING)
            values["gravity load"][fault.robot][:, _BEARING] += begun[:, None] * shares
    for value in values.values():
        value *= 1.0 + _MEASURED * random.standard_normal(value.shape)
    months = np.array([[(e.when - FIRST) / MONTH for e in robot] for robot in conditions])
    logged = {
        "temperature": [[[each.temperature] for each in robot] for robot in conditions],
        "minutes since start": [[[each.minutes] for each in robot] for robot in conditions],
        "nothing": [[[] for _ in robot] for robot in conditions],
    }
    columns = np.array(logged[known])
    followed: list[tuple[Followed, int]] = [
        *(("friction", joint) for joint in range(6)),
        *(("gravity load", joint) for joint in _BEARING),
    ]
    first: dict[Place, int] = {}
    last: dict[Place, Course] = {}
    for month in range(_FIRST_ASKED, plan.months + 1):
        found: dict[Place, Course] = {}
        for quantity, joint in followed:
            family = []
            for robot in range(plan.robots):
                value = values[quantity][robot, :month, joint]
                relative = value / value[:3].mean() - 1.0
                variance = np.full(month, _MEASURED**2)
                family.append(
                    Series(months[robot, :month], relative, variance, columns[robot, :month])
                )
            family = warmed(family, [known][: columns.shape[2]])
            for robot, course in enumerate(courses(family)):
                if course is not None:
                    found[Place(robot, quantity, joint)] = course
            if (common := common_course(family)) is not None:
                found[Place(EVERY, quantity, joint)] = common.course
        adjusted = holm(np.array([each.p_value for each in found.values()]))
        for (place, each), p_value in zip(found.items(), adjusted.tolist(), strict=True):
            if p_value < FALSE_ALARM_RATE and each.largest >= MIN_RELATIVE_CHANGE:
                first.setdefault(place, month - 1)
                last[place] = each
    results = []
    caused: set[Place] = set()
    for fault in plan.faults:
        joints = _BEARING if fault.kind == "tool" else (fault.joint,)
        places = [Place(fault.robot, fault.quantity, joint) for joint in joints]
        caused.update(places)
        alarms = [first[place] for place in places if place in first]
        begins = [c.shape.begin for place in places if place in last for c in last[place].changes]
        error = min((abs(begin - fault.month) for begin in begins), default=np.inf)
        results.append((fault, min(alarms, default=None), float(error)))
    return Outcome(results, len(first.keys() - caused), plan.months / 12.0)


def main() -> None:
    """Print how soon faults are found, how well they are dated, and how many alarms are false."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--fleets", type=int, default=4, help="with faults, and without, each")
    parser.add_argument("--logged", choices=get_args(Known), nargs="*", default=get_args(Known))
    options = parser.parse_args()
    fleets = options.fleets
    begun = process_time()
    for known in options.logged:
        faulty = [watched(planned(seed, faulty=True), known) for seed in range(fleets)]
        others = [watched(planned(100 + k, faulty=False), known) for k in range(fleets)]
        every = [result for outcome in faulty for result in outcome.found]
        # Wear that has not passed 10 % two months before the end need not be found.
        due = [(f, m, e) for f, m, e in every if f.passes_tenth + _IN_TIME < 23.0]
        soon = [
            m is not None and m <= np.ceil(max(f.passes_tenth, _FIRST_ASKED)) + _IN_TIME
            for f, m, _ in due
        ]
        dated = [error <= 1.0 for _, _, error in due]
        years = sum(outcome.years for outcome in (*faulty, *others))
        alarms = sum(outcome.alarms for outcome in (*faulty, *others))
        print(
            f"{known} logged: {sum(soon)} of {len(due)} faults found"
            f" within two months of 10 %, {sum(dated)} dated within a month;"
            f" {alarms} false alarms in {years:.0f} fleet-years"
        )
        for fault, month, error in due:
            alarm = "no alarm" if month is None else f"alarm {month}"
            when = f"10 % at {fault.passes_tenth:.1f}, begin off by {error:.2f} months"
            whose = " of all" if fault.robot == EVERY else ""
            print(f"  {fault.kind}{whose} {fault.size:+.3f} at {fault.month:.1f}: {alarm}, {when}")
    print(f"{process_time() - begun:.0f} s of processor time")


if __name__ == "__main__":
    main()
