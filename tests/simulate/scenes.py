"""An arm that can do what is planned for it: cell, plan and controller, drawn until they fit."""

from __future__ import annotations

import random
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hil.campaign.intervals import require_runnable
from hil.campaign.plan import CampaignPlan, PlannedMotion
from hil.cell import Cell
from hil.errors import HilError
from hil.motion_checks import MotionChecks
from hil.simulation import controller_settings
from identification.excitation import RESCORE_PERIOD, Excitation, Objective
from planner import FourierSeries, PiecewiseCubic, PlanningError, plan_in_child
from sim_fixtures import ControllerSettings
from sim_fixtures.settings import ServoSettings
from tests.simulate.arms import Arm, draw_arm

Array = NDArray[np.float64]

NEIGHBOURS: Final = 8  # Seeds in a row that share arm, plan and the run without faults
_ARMS: Final = 20
_MOTIONS: Final = 12
_QUICK_SERVO: Final = ServoSettings(position_gain=30.0, model_error=(0.01, 0.03))
"""Comes to rest within the short time that a motion's end is held here."""
_SHORTEST: Final = 0.35
_LONGEST: Final = 0.55  # s of one motion


@dataclass(frozen=True, eq=False)
class Scene:
    """What neighbouring seeds share."""

    group: int  # seed // NEIGHBOURS
    arm: Arm
    cell: Cell
    plan: CampaignPlan  # drawn, and sound together
    controller: ControllerSettings  # how the controller behaves where nothing goes wrong
    words: str  # what was drawn


def scene_of(group: int, variant: int = 0) -> Scene:
    """The scene of a group of seeds; another one where an earlier variant was of no use.

    Raises:
        RuntimeError: none was found; the way arms are drawn is at fault.
    """
    for attempt in range(_ARMS):
        chance = random.Random(f"scene {group} {variant} {attempt}")
        arm = draw_arm(chance)
        cell = Cell.from_texts(arm.cell, arm.urdf, Path("cell.toml"))
        plan = _draw_plan(chance, cell)
        if plan is not None:
            words = f"{arm.words}; {_words_of(plan)}; {cell.campaign.repetitions} repetitions"
            return Scene(group, arm, cell, plan, _controller(chance, arm, cell), words)
    raise RuntimeError(f"no sound scene for group {group} in {_ARMS} arms")


def _words_of(plan: CampaignPlan) -> str:
    lasts = plan.excitation.trajectory.duration
    return f"{plan.excitation.method}, {lasts:.2f} s"


def _draw_plan(chance: random.Random, cell: Cell) -> CampaignPlan | None:
    """An excitation and a validation motion within all limits; None if none was found."""
    checks = MotionChecks.of(cell)
    sines = chance.random() < 0.25
    found: list[Excitation] = []
    for size in np.linspace(1.0, 0.25, _MOTIONS):
        motion = _sines(chance, cell, size) if sines and not found else _vias(chance, cell, size)
        if motion is None or checks.refusal(motion.trajectory) is not None:
            continue
        found.append(motion)
        if len(found) == 2:
            break
    if len(found) < 2:
        return None
    plan = CampaignPlan(found[0], (PlannedMotion(found[1].trajectory),))
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
    """Random via points about home; rounded by as much as the size of the motion."""
    n, limits = len(cell.joint_names), cell.joint_limits
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
