"""Servos with the terms of a simulator alone, fitted to the same windows.

A simulator without friction that grows with the load, static friction or a rate of the command gets
the values with which it comes closest to the motion, not the values of a model with these terms.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final, Literal, get_args

import numpy as np

from identification.arrays import Array
from identification.servo.choice import FIT_ITERATIONS
from identification.servo.fit import ServoWindows, fit
from identification.servo.parameters import NAMES
from identification.servo.recorded_motion import ServoMotion
from identification.servo.servo_fit import ServoFit
from identification.servo.touches import windows_without

Engine = Literal["mujoco", "physx"]
ENGINES: Final[tuple[Engine, ...]] = get_args(Engine)

_COMMON: Final = ("kp", "armature", "viscous", "coulomb", "delay", "offset", "limit")
TERMS_OF_ENGINE: Final[Mapping[Engine, tuple[str, ...]]] = {
    "mujoco": _COMMON,
    "physx": (*_COMMON, "static", "speed"),
}
"""Terms of an engine. Damping of the motor and of the joint brake alike, so that both are
`viscous`; PhysX has static friction above the dynamic one, MuJoCo (and Genesis) has not."""


def fits_in_simulators(
    motions: Sequence[ServoMotion],
    found: ServoFit,
    resolution: Array,
    *,
    done: Callable[[], None] = lambda: None,
) -> dict[Engine, ServoFit]:
    """Return the fit with the terms of each engine, from a fit with all terms.

    Args:
        motions: that are fitted.
        found: fit with all terms, from which these start.
        resolution: standard deviation of the measured positions (n,).
        done: called after each iteration.
    """
    windows = windows_without(ServoWindows.of(motions), found.left_out)
    best = found.estimate
    fits = dict[Engine, ServoFit]()
    for engine in ENGINES:
        present = best.present & np.isin(NAMES, TERMS_OF_ENGINE[engine])
        if (present == best.present).all():
            fits[engine] = found
            continue
        estimate = fit(
            windows, best.prior, present, best.coordinates, resolution, iterations=FIT_ITERATIONS,
            bus=best.bus_delay, done=done,
        )  # fmt: skip
        fits[engine] = replace(found, estimate=estimate, choices=(), shown=found.shown & present)
    return fits
