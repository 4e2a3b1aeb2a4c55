"""What checks of bounds at their edges have in common."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from drivers import GuardLimits
from drivers.errors import GuardError
from tests.drivers.rig import N, limits

REST = np.zeros(N)
WIDE = 1e9
JUST_BELOW, JUST_ABOVE = 1.0 + 5e-7, 1.0 + 2e-6
"""Of a bound, which has a relative tolerance of 1e-6."""
FACTORS = {"plan": (1.0, 1.0), "override": (1.3, 1.7), "stop": (2.0, 3.0)}
"""On acceleration and jerk, of each set of bounds."""

joints = pytest.mark.parametrize("joint", [0, N - 1])
signs = pytest.mark.parametrize("sign", [-1.0, 1.0])


def at(joint: int, value: float) -> np.ndarray:
    """Zero but for one joint."""
    return value * np.eye(N)[joint]


def only(**bounds: float) -> GuardLimits:
    """Every rate but those given is out of reach."""
    wide = dict.fromkeys(("velocity", "acceleration", "jerk"), WIDE)
    return limits(**{name: np.full(N, bound) for name, bound in (wide | bounds).items()})


def refused(kind: type, check: Callable[..., object], *args: Any, **named: Any) -> GuardError:
    """What a check raises, which is of exactly this kind."""
    with pytest.raises(GuardError) as caught:
        check(*args, **named)
    assert type(caught.value) is kind
    return caught.value
