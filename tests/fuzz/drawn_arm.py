"""Arms as a controller's init packet lays them out, and a controller that may obey."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from drivers import DriveTrain, GuardLimits, InitPacket
from tests.drivers.model_controller import Controller
from tests.drivers.rig import train_of

CYCLE_MS = 2
"""Of every arm: the tables of motions are made for it, and would be too fast in a shorter one."""


@dataclass(frozen=True, eq=False)
class Arm:
    """An arm and where its axes stand in a packet."""

    n: int  # joints
    number: int  # of the arm, from 1
    axes: tuple[tuple[int, int], ...]  # (arm from 1, axis from 0) of each slot
    period: float  # of the controller [s]
    train: DriveTrain  # drive train
    limits: GuardLimits  # of the guard
    init: bytes  # the init packet that fits
    other: bytes  # one whose gear ratios are another arm's

    @property
    def middle(self) -> np.ndarray:
        """Joints (n,) [rad] within their range, each elsewhere."""
        return np.linspace(-0.5, 0.5, self.n)

    @property
    def slots(self) -> tuple[int, ...]:
        """Slot of each joint."""
        return tuple(self.axes.index((self.number, joint)) for joint in range(self.n))

    @property
    def arms(self) -> tuple[int, ...]:
        """Arm of each slot."""
        return tuple(arm for arm, _ in self.axes)


@lru_cache(maxsize=64)
def arm_of(n: int, number: int, order: int, foreign: int) -> Arm:
    """An arm of `n` joints among `foreign` axes that are not its own, in a drawn order."""
    own = [(number, joint) for joint in range(n)]
    strangers = [(number, 9), (number % 4 + 1, 0), (number % 4 + 1, 3)][:foreign]
    mixed = np.random.default_rng(order).permutation(n + foreign) if order else range(n + foreign)
    axes = tuple((own + strangers)[k] for k in mixed)
    train = train_of(n)
    limits = GuardLimits(
        lower=np.full(n, -2.0),
        upper=np.full(n, 2.0),
        velocity=np.full(n, 2.0),
        acceleration=np.full(n, 8.0),
        jerk=np.full(n, 100.0),
        following_error=np.full(n, 2.0),
        current=np.full(n, 20.0),
    )
    made = [init_of(axes, number, train, n, ratio) for ratio in (1.0, 1.5)]
    return Arm(n, number, axes, CYCLE_MS / 1000, train, limits, *made)


def init_of(
    axes: tuple[tuple[int, int], ...], number: int, train: DriveTrain, n: int, ratio: float
) -> bytes:
    """An init packet with these slots; `ratio` is that of its gears to the arm's."""
    table = np.full((4, 10), 0xFF)
    for slot, (arm, axis) in enumerate(axes):
        table[arm - 1, axis] = slot
    rows = {name: np.zeros((4, 10)) for name in ("gear_ratio", "calibration")}
    rows["gear_ratio"][number - 1, :n] = ratio * train.gear_ratio
    rows["calibration"][number - 1, :n] = train.calibration
    influence = np.zeros((4, 10))
    influence[number - 1, 3:6] = train.k54, train.k64, train.k65
    init = InitPacket.build(
        1, CYCLE_MS, {}, open_axes_map=table, kinematic_influence=influence,
        following_error=np.full((4, 10), 2.0), current_limit=np.full((4, 10), 20.0), **rows,
    )  # fmt: skip
    init.record["n_axes"] = len(axes)
    return init.encode()


def controller_of(arm: Arm) -> Controller:
    """One that begins with its arm in the middle of its range."""
    return Controller(arm.train, arm.middle, arm=arm.number, n_axes=len(arm.axes), slots=arm.slots)
