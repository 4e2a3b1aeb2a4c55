"""figaroh's side of `benchmarks.identification`, run by an interpreter that has figaroh installed.

Run by that benchmark as ``PYTHON figaroh_rival.py URDF SAMPLES.npz RESULT.npz``. For every name of
a route on a line of its standard input it runs that route once and answers with one line of JSON,
the processor time [s]; at the end of input it writes what the routes found. All of them begin with
`build_regressor_basic` and `get_index_eliminate`, and end with the weighted least squares of
`BaseIdentification` (base columns weighted by each joint's residual variance, relative standard
deviations). In between:

- ``double``: `QRDecomposer.double_decomposition`, what `BaseIdentification.solve` does, without
  its printing and without decimation;
- ``pivoting``: `QRDecomposer.decompose_with_pivoting`, its faster alternative;
- ``known``: `build_baseRegressor` with base columns that were found beforehand.

The inertial parameters, viscous and Coulomb friction, actuator inertia and offset of every joint.
"""

# ruff: noqa: E402 - threads are pinned before numpy is imported, or BLAS does not see it

from __future__ import annotations

import os

for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"

import json
import logging
import sys
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np

logging.disable(logging.WARNING)
warnings.simplefilter("ignore")

from figaroh.identification.base_identification import (  # type: ignore[import-not-found]
    BaseIdentification,
)
from figaroh.identification.parameter import (  # type: ignore[import-not-found]
    add_standard_additional_parameters,
    get_standard_parameters,
)
from figaroh.tools.qrdecomposition import (  # type: ignore[import-not-found]
    QRDecomposer,
    build_baseRegressor,
    get_baseIndex,
)
from figaroh.tools.regressor import (  # type: ignore[import-not-found]
    build_regressor_basic,
    build_regressor_reduced,
    get_index_eliminate,
)
from figaroh.tools.robot import Robot  # type: ignore[import-not-found]

TOLERANCE = 1e-3
"""Of `get_index_eliminate`, the default of `BaseIdentification.solve`."""


class Identification(BaseIdentification):  # type: ignore[misc]
    """figaroh's weighted least squares on rows that are there already."""

    def __init__(self, settings: dict[str, Any]) -> None:
        self.identif_config = settings

    def load_trajectory_data(self, data_source: Any = None) -> Any:
        """A loader, which figaroh asks of every class; here the samples are handed over."""
        raise RuntimeError(f"samples are handed over, none are loaded from {data_source!r}")

    def weighted(self, base: Any, torque: Any, values: Any) -> tuple[Any, Any]:
        """Values and relative standard deviations, from base columns and a first estimate."""
        self.dynamic_regressor_base = base
        self.tau_noised = torque
        self.phi_base = values
        return self._apply_weighted_least_squares()  # type: ignore[no-any-return]

    def ordinary(self, base: Any, torque: Any) -> Any:
        """Ordinary least squares the same way, by normal equations."""
        return self._solve_weighted_least_squares(base, torque, np.ones(len(torque)))[0]


class Rival:
    """The routes, on one robot and one set of samples."""

    def __init__(self, urdf: str, samples: Path) -> None:
        self.robot = Robot(urdf, str(Path(urdf).parent))
        n = self.robot.model.nv
        self.settings = {
            "is_joint_torques": True,
            "has_friction": True,
            "has_actuator_inertia": True,
            "has_joint_offset": True,
            "act_idxv": list(range(n)),
            "active_joints": list(self.robot.model.names[1:]),
            "fv": [0.0] * n,
            "fs": [0.0] * n,
            "Ia": [0.0] * n,
            "off": [0.0] * n,
        }
        self.standard = get_standard_parameters(self.robot.model, self.settings)
        self.standard |= add_standard_additional_parameters(self.robot.model, self.settings)
        with np.load(samples) as file:
            self.motion = file["position"], file["velocity"], file["acceleration"]
            self.torque = file["torque"].T.flatten()  # joint by joint, as their regressor's rows
        self.estimator = Identification(self.settings)
        regressor, names = self._columns()
        self.known = get_baseIndex(regressor, names)
        self.found: dict[str, Any] = {}

    def _columns(self) -> tuple[Any, list[str]]:
        regressor = build_regressor_basic(self.robot, *self.motion, self.settings)
        eliminated, names = get_index_eliminate(regressor, self.standard, tol_e=TOLERANCE)
        return build_regressor_reduced(regressor, eliminated), names

    def run(self, route: str) -> float:
        """Processor time of one run of a route."""
        start = time.process_time()
        columns, names = self._columns()
        if route == "known":
            base = build_baseRegressor(columns, self.known)
            first = self.estimator.ordinary(base, self.torque)
        elif route == "pivoting":
            base, parameters = QRDecomposer().decompose_with_pivoting(self.torque, columns, names)
            first = np.array(list(parameters.values()))
        else:
            base, _, _, first, _ = QRDecomposer().double_decomposition(
                self.torque, columns, names, self.standard
            )
        values, deviation = self.estimator.weighted(base, self.torque, first)
        took = time.process_time() - start
        self.found[route] = base @ values
        self.found[f"{route}_std"] = deviation
        return took


def main() -> None:
    """Answer requests until there are none."""
    urdf, samples, result = sys.argv[1:]
    rival = Rival(urdf, Path(samples))
    for line in sys.stdin:
        print(json.dumps(rival.run(line.strip())), flush=True)
    np.savez(result, **rival.found)


if __name__ == "__main__":
    main()
