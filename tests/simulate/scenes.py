"""Random cell, plan and controller of a simulated campaign."""

from __future__ import annotations

import random
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.base.errors import HilError
from hil.campaign.plan import CampaignPlan, PlannedMotion
from hil.campaign.planned_motions import require_runnable
from hil.cell import Cell
from hil.control.motion_checks import MotionChecks
from hil.control.simulated_cell import controller_settings
from identification.excitation import RESCORE_PERIOD, Excitation, Objective
from planner import FourierSeries, PiecewiseCubic, PlanningError, plan_in_child
from sim_fixtures import ControllerSettings
from sim_fixtures.settings import ServoSettings

SHAPES: Final = ("upright", "serial", "planar")
"""UR-like (a turning base, three parallel axes, a wrist), NS 16-like (wrist in line), parallel."""
_AXES: Final = {
    "upright": ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1"),
    "serial": ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1", "0 1 0"),
    "planar": ("0 1 0",) * 7,
}
_REACH: Final = (0.25, 0.4, 0.36, 0.14, 0.12, 0.1, 0.08)  # m from each joint to the next
_MASS: Final = (14.0, 11.0, 6.0, 2.5, 2.0, 1.2, 0.8)  # kg


@dataclass(frozen=True)
class Arm:
    """URDF and cell file of an arm."""

    urdf: str
    cell: str  # with the URDF `arm.urdf`
    n_joints: int  # 1 to 7
    foreign_axes: int  # axes of another arm at the same controller
    words: str  # description


def draw_arm(chance: random.Random) -> Arm:
    """Return a random arm with drives, limits, controller and truth."""
    n = chance.choices(range(1, 8), (4, 9, 5, 2, 1, 2, 1))[0]
    shape = chance.choice(SHAPES)
    mass = [m * chance.uniform(0.6, 1.4) for m in _MASS[:n]]
    reach = [r * chance.uniform(0.8, 1.2) for r in _REACH[:n]]
    cycle = chance.choice((1, 2, 2, 2))
    coupled = n >= 6 and chance.random() < 0.7
    foreign = chance.choice((0, 0, 0, 1, 3))
    arm = chance.choice((1, 1, 1, 1, 2, 4))
    where = _controller_text(chance, cycle, arm, foreign)
    text = "\n".join((*_cell_text(chance, n, mass, reach, cycle=cycle, coupled=coupled), *where))
    description = f"{n} joints, {shape}, {cycle} ms" + (", coupled wrist" if coupled else "")
    return Arm(_urdf(chance, shape, mass, reach), text, n, foreign, description)


def _urdf(chance: random.Random, shape: str, mass: Sequence[float], reach: Sequence[float]) -> str:
    parts = ['<robot name="drawn"><link name="base"/>']
    for i, (m, length) in enumerate(zip(mass, reach, strict=True)):
        x = chance.uniform(-0.04, 0.04)
        y = chance.uniform(-0.04, 0.04)
        z = 0.45 * length
        wide = chance.uniform(0.05, 0.09)
        along = m * (length**2 + wide**2) / 12.0
        across = m * wide**2 / 6.0
        lift = 0.3 if i == 0 else reach[i - 1]
        parts.append(
            f'<link name="link_{i + 1}"><inertial><mass value="{m:.6g}"/>'
            f'<origin xyz="{x:.6g} {y:.6g} {z:.6g}"/><inertia ixx="{along:.6g}" ixy="0" ixz="0" '
            f'iyy="{1.1 * along:.6g}" iyz="0" izz="{across:.6g}"/></inertial>'
            '<collision><geometry><sphere radius="0.01"/></geometry></collision></link>'
            f'<joint name="joint_{i + 1}" type="revolute"><parent link="'
            f'{"base" if i == 0 else f"link_{i}"}"/><child link="link_{i + 1}"/>'
            f'<origin xyz="0 0 {lift:.6g}"/><axis xyz="{_AXES[shape][i]}"/>'
            '<limit lower="-3" upper="3" effort="2000" velocity="12"/></joint>'
        )
    return "".join([*parts, "</robot>\n"])


def _list(values: Iterable[float]) -> str:
    return "[" + ", ".join(f"{value:.9g}" for value in values) + "]"


def _cell_text(
    chance: random.Random,
    n: int,
    mass: Sequence[float],
    reach: Sequence[float],
    *,
    cycle: int,
    coupled: bool,
) -> Iterable[str]:
    gear = [chance.choice((-1, 1)) * round(chance.uniform(60.0, 140.0), 2) for _ in range(n)]
    constant = [round(chance.uniform(0.2, 0.6), 3) for _ in range(n)]
    # Approximate inertia of the stretched arm; rotors are of similar size.
    arm = [sum(mass[i:]) * sum(reach[i:]) ** 2 / 3.0 for i in range(n)]
    rotor = [chance.uniform(0.5, 1.0) * inertia + 0.1 for inertia in arm]
    coulomb = [1.0 + chance.uniform(0.3, 0.8) * mass[i] for i in range(n)]
    viscous = [chance.uniform(0.1, 0.4) * mass[i] for i in range(n)]
    # Three times the static torque of the stretched arm, and a torque for acceleration.
    weight = [9.81 * sum(mass[i:]) * sum(reach[i:]) for i in range(n)]
    torque = [3.0 * w + 120.0 * (r + i) for w, r, i in zip(weight, rotor, arm, strict=True)]
    current = [
        round(max(2.0, t / abs(g) / k), 3) for t, g, k in zip(torque, gear, constant, strict=True)
    ]
    home = [round(chance.uniform(-25.0, 25.0), 1) for _ in range(n)]
    away = chance.choice((0.0, 0.0, 3.0))
    initial = [round(h + chance.uniform(-away, away), 1) for h in home]
    speed = [round(chance.uniform(150.0, 400.0), 1) for _ in range(n)]
    ease = [round(s * chance.uniform(10.0, 18.0)) for s in speed]
    jerk = [round(a * chance.uniform(25.0, 45.0)) for a in ease]
    k54, k64, k65 = (round(chance.uniform(-0.06, 0.06), 4) if coupled else 0.0 for _ in range(3))
    yield '[cell]\nname = "drawn"\nurdf = "arm.urdf"\n'
    yield '[robot.friction]\nthird = "none"\nstandstill = 0.05\n'
    yield f"[nominal]\nrotor_inertia = {_list(rotor)}\ncoulomb = {_list(coulomb)}"
    yield f"viscous = {_list(viscous)}\n"
    yield f'[limits]\nframe = "urdf"\nlower_deg = {_list(h - 45.0 for h in home)}'
    yield f"upper_deg = {_list(h + 45.0 for h in home)}\nvelocity_deg = {_list(speed)}"
    yield f"acceleration_deg = {_list(ease)}\njerk_deg = {_list(jerk)}\n"
    yield f"[drive_train]\ngear_ratio = {_list(gear)}"
    yield f"calibration = {_list(round(chance.uniform(-40.0, 40.0), 3) for _ in range(n))}"
    yield f"k54 = {k54}\nk64 = {k64}\nk65 = {k65}"
    yield f"joint_sign = {[chance.choice((-1, 1)) for _ in range(n)]}"
    yield f"joint_offset_deg = {_list(chance.choice((0.0, 90.0, -11.5)) for _ in range(n))}"
    yield f"torque_constant = {_list(constant)}\ncurrent_limit = {_list(current)}"
    yield f"following_error = {_list(round(0.03 * abs(g), 3) for g in gear)}"
    yield "encoder_counts_per_revolution = 65536\n"
    yield '[workspace]\nfloor = "none"\nmargin = 0.0\n'
    repetitions = chance.choice((1, 1, 1, 2, 3) if cycle == 2 else (1, 1, 2))
    yield f"[campaign]\nrepetitions = {repetitions}\nvalidation_runs = 1"
    yield f"home_deg = {_list(home)}\napproach_speed = 1.0\nsettle_s = 0.16\nstandstill_s = 0.1"
    yield f"warmup_drift = 0\nbad_repetitions = {chance.choice((1, 3))}\n"
    yield f"[simulation]\nseed = {chance.randrange(1 << 30)}\ninitial_deg = {_list(initial)}"
    yield f"rotor_inertia = {_list(rotor)}\ncoulomb = {_list(coulomb)}"
    yield f"viscous = {_list(viscous)}\nthird = {_list([0.0] * n)}"
    yield "current_noise = 0.01\ncurrent_resolution = 0.001\n"


def _controller_text(chance: random.Random, cycle: int, arm: int, foreign: int) -> Iterable[str]:
    other = 1 if arm > 1 else 2
    yield f'[controller]\ntransport = "simulated"\ncycle_ms = {cycle}\narm = {arm}'
    yield f"current_delay_cycles = {0.5 - 0.3 / cycle:.9g}\nmax_gap = {chance.choice((1, 2, 2, 4))}"
    yield f"other_axes = {[[other, axis] for axis in range(1, foreign + 1)]}"
    yield f"packets = {'true' if chance.random() < 0.2 else 'false'}\n"


Array = NDArray[np.float64]

NEIGHBOURS: Final = 8  # consecutive seeds with the same arm, plan and run without faults
_ARMS: Final = 20
_MOTIONS: Final = 12
_QUICK_SERVO: Final = ServoSettings(position_gain=30.0, model_error=(0.01, 0.03))
"""Stops within the short settling time of these cells."""
_SHORTEST: Final = 0.35
_LONGEST: Final = 0.55  # s of one motion


@dataclass(frozen=True, eq=False)
class Scene:
    """Arm, plan and controller of a group of seeds."""

    group: int  # seed // NEIGHBOURS
    arm: Arm
    cell: Cell
    plan: CampaignPlan
    controller: ControllerSettings  # without faults
    words: str  # description


def scene_of(group: int, variant: int = 0) -> Scene:
    """Return the scene of a group of seeds; `variant` counts the rejected ones before it.

    Raises:
        RuntimeError: none was found.
    """
    for attempt in range(_ARMS):
        chance = random.Random(f"scene {group} {variant} {attempt}")
        arm = draw_arm(chance)
        cell = Cell.from_texts(arm.cell, arm.urdf, Path("cell.toml"))
        plan = _draw_plan(chance, cell)
        if plan is not None:
            description = f"{arm.words}; {_words_of(plan)}; {cell.campaign.repetitions} repetitions"
            return Scene(group, arm, cell, plan, _controller(chance, arm, cell), description)
    raise RuntimeError(f"no usable scene for group {group} in {_ARMS} arms")


def _words_of(plan: CampaignPlan) -> str:
    lasts = plan.excitation.trajectory.duration
    return f"{plan.excitation.method}, {lasts:.2f} s"


def _draw_plan(chance: random.Random, cell: Cell) -> CampaignPlan | None:
    """Return an excitation and a validation motion within all limits, or None."""
    checks = MotionChecks.of(cell)
    sines = chance.random() < 0.25
    excitations: list[Excitation] = []
    for size in np.linspace(1.0, 0.25, _MOTIONS):
        motion = (
            _sines(chance, cell, size) if sines and not excitations else _vias(chance, cell, size)
        )
        if motion is None or checks.refusal(motion.trajectory) is not None:
            continue
        excitations.append(motion)
        if len(excitations) == 2:
            break
    if len(excitations) < 2:
        return None
    plan = CampaignPlan(excitations[0], (PlannedMotion(excitations[1].trajectory),))
    try:
        require_runnable(cell, plan, checks)
    except HilError:
        return None
    return plan


def _excitation(
    cell: Cell,
    trajectory: PiecewiseCubic | FourierSeries,
    method: str,
    via_points: Array | None = None,
    speed: Array | None = None,
    fly: float | None = None,
) -> Excitation:
    criteria = Objective(cell.model).criteria(trajectory, RESCORE_PERIOD)
    return Excitation(trajectory, criteria, method, 0, 1, {}, via_points, speed, fly)


def _vias(chance: random.Random, cell: Cell, size: float) -> Excitation | None:
    """Return a motion through random via points about home, or None."""
    n = len(cell.joint_names)
    limits = cell.joint_limits
    home = cell.home
    reach = np.minimum(np.radians(28.0), 0.9 * (limits.upper - home)) * size
    points = [
        home + reach * np.array([chance.uniform(-1.0, 1.0) for _ in range(n)])
        for _ in range(chance.randint(2, 3))
    ]
    via = np.array([home, *points, home])
    speed = np.array([chance.uniform(0.6, 1.0) for _ in range(n)])
    fly = chance.choice((0.0, 0.5, 1.0))
    try:
        trajectory = plan_in_child(via, limits, speed=speed, fly=fly)
    except PlanningError:
        return None
    if not _SHORTEST <= trajectory.duration <= _LONGEST:
        return None
    return _excitation(cell, trajectory, "random", via, speed, fly)


def _sines(chance: random.Random, cell: Cell, size: float) -> Excitation | None:
    n = len(cell.joint_names)
    length = chance.uniform(0.4, _LONGEST)
    amplitude = [[chance.uniform(-0.1, 0.1) * size for _ in range(2)] for _ in range(n)]
    frequency = [[chance.uniform(4.0, 22.0) for _ in range(2)] for _ in range(n)]
    trajectory = FourierSeries(
        cell.home, np.array(amplitude), np.array(frequency), length, 0.35 * length
    )
    return _excitation(cell, trajectory, "sines")


def _controller(chance: random.Random, arm: Arm, cell: Cell) -> ControllerSettings:
    slots = None
    if chance.random() < 0.2:
        slots = tuple(chance.sample(range(arm.n_joints + arm.foreign_axes), arm.n_joints))
    return replace(
        controller_settings(cell),
        arm=cell.controller.arm,
        encoder_noise=chance.choice((0.0, 0.5, 1.0)),
        drive_off_cycles=chance.randint(3, 12),
        driving_on_cycles=chance.randint(3, 12),
        closed_cycles=chance.randint(3, 10),
        closing_cycles=chance.randint(1, 6),
        closing_stagger=chance.choice((0, 0, 2)),
        opening_stagger=chance.choice((0, 1, 3)),
        foreign_axes=arm.foreign_axes,
        slots=slots,
        servo=_QUICK_SERVO,
        silence_limit=100,
        long_packets=chance.random() < 0.15,
        ramp_time=0.1,
        boot_time=0.15,
    )
