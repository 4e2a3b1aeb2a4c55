from __future__ import annotations

import numpy as np
import pytest

from identification.model.wrench import LINK_SYMBOLS, N_PRIMITIVES, wrench_matrix, write_primitives

TENSOR = {"Ixx": (0, 0), "Ixy": (0, 1), "Ixz": (0, 2), "Iyy": (1, 1), "Iyz": (1, 2), "Izz": (2, 2)}


@pytest.mark.parametrize("symbol", LINK_SYMBOLS)
def test_the_wrench_of_each_parameter_is_newtons_and_eulers(symbol: str) -> None:
    omega, speed, alpha, spatial = np.random.default_rng(0).normal(size=(4, 3))
    # Acceleration of the link's origin, from the spatial one.
    a = spatial + np.cross(omega, speed)
    tensor, moment, mass = np.zeros((3, 3)), np.zeros(3), 0.0
    if symbol in TENSOR:
        i, j = TENSOR[symbol]
        tensor[i, j] = tensor[j, i] = 1.0
    elif symbol == "m":
        mass = 1.0
    else:
        moment["xyz".index(symbol[-1])] = 1.0
    force = mass * a + np.cross(alpha, moment) + np.cross(omega, np.cross(omega, moment))
    torque = tensor @ alpha + np.cross(omega, tensor @ omega) + np.cross(moment, a)

    motion = np.array([[omega, speed], [alpha, spatial]])[None, ..., None]
    primitives = np.empty((1, N_PRIMITIVES, 1))
    write_primitives(motion, primitives)
    wrench = wrench_matrix(LINK_SYMBOLS.index(symbol)) @ primitives[0, :, 0]
    assert np.allclose(wrench, [*torque, *force], atol=1e-14)
