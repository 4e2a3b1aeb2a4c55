"""The arm of two links that most tests here are about, and the parameters planted in it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from identification.model.robot import RobotModel
from tests.identification import two_link


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return two_link.MODEL


@pytest.fixture(scope="module")
def truth() -> NDArray[np.float64]:
    return two_link.truth()
