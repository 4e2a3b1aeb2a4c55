"""Time of a rollout: 1 000 windows of a second, of 50 arms of six axes.

    python -m benchmarks.rollout

The arm is the nominal NS 16 (simulated), its torque along sines is exact. Prints time and processor
time; wanted are 30 s on two idle cores.
"""

from __future__ import annotations

import time

import numpy as np

from hil.cell import Cell
from identification import Samples
from identification.export.arm import Arm, Ranges
from identification.model.motion import Motion
from identification.rollout.comparison import (
    RecordedMotion,
    light_feedback,
    recorded_stretches,
    simulate,
)
from identification.rollout.windows import STEP, windows_of
from sim_fixtures.ns16 import CELL_PATH

WINDOWS, ARMS = 1000, 50


def recorded(arm: Arm) -> RecordedMotion:
    """Return windows of the arm's exact torque along sines."""
    model, random = arm.model, np.random.default_rng(1)
    stride = 0.1
    duration = 1.2 + stride * (WINDOWS - 1)
    grid = np.arange(0.0, duration, 0.002)
    rate, phase = random.uniform(1.0, 4.0, model.n_joints), random.uniform(0.0, 6.0, model.n_joints)
    angle = rate * grid[:, None] + phase
    motion = Motion(
        grid, 0.3 * np.sin(angle), 0.3 * rate * np.cos(angle), -0.3 * rate**2 * np.sin(angle)
    )
    torque = model.torque(arm.values, *motion[1:4])
    everything = np.ones(torque.shape, dtype=np.bool_)
    bandwidth = np.full(model.n_joints, np.inf)
    samples = Samples(motion, torque, everything, (slice(0, len(grid)),), 0.0, bandwidth)
    stretches, owners = recorded_stretches(model, [(samples, None)], STEP)
    return RecordedMotion(windows_of(stretches, STEP, 1.0, stride).some(WINDOWS), tuple(owners))


def main() -> None:
    """Print the time."""
    cell = Cell.load(CELL_PATH)
    model, infinite = cell.model, np.full(len(cell.joint_names), np.inf)
    standard = model.nominal
    standard[model.layout.rotors] = cell.nominal.rotor_inertia
    ranges = Ranges(-infinite, infinite, infinite, infinite)
    arm = Arm(cell.urdf, model, standard, cell.nominal_values(), ranges)
    motion, feedback = recorded(arm), light_feedback(arm, STEP, 1.0)
    begin, processor = time.perf_counter(), time.process_time()
    for _ in range(ARMS):
        simulate(arm, motion, feedback)
    wall, cpu = time.perf_counter() - begin, time.process_time() - processor
    print(
        f"{len(motion.windows)} windows of 1 s x {ARMS} arms of {model.n_joints} axes:"
        f" {wall:.1f} s, {cpu:.1f} s of processor time"
    )


if __name__ == "__main__":
    main()
