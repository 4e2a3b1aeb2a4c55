"""The Staeubli TX40 with its coupled wrist: real data, not part of the repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from identification import FrictionLaw, Preprocessing, Recording, RobotModel, prepare
from identification.factor.factor import Estimate, Factor, estimate
from identification.model.coupling import Coupling
from identification.validation.prediction import PredictionError, prediction_error

DATA = Path(__file__).resolve().parents[3] / "shared" / "data" / "tx40"
GEARS = np.array([32.0, 32.0, 45.0, -48.0, 45.0, 32.0])
# Joint 5 turns motor 6 along (Gautier; the same in the published identification of this arm).
TURNS = np.diag(GEARS)
TURNS[5, 4] = GEARS[5]
HOME = np.array([0.0, -np.pi / 2, np.pi / 2, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def recording() -> Recording:
    if not DATA.is_dir():
        pytest.skip(f"there are no recordings at {DATA}")
    motor, torque = (
        np.loadtxt(DATA / name, delimiter=",", skiprows=1)
        for name in ("pos_read_data.csv", "curr_data.csv")
    )
    return Recording(
        time=np.arange(len(motor)) * 2e-4,
        position=motor @ np.linalg.inv(TURNS).T + HOME,
        joint_names=tuple(f"joint_{j}" for j in range(1, 7)),
        torque=torque @ TURNS,
    )


def fitted(recording: Recording, coupling: Coupling | None) -> tuple[Estimate, PredictionError]:
    model = RobotModel.from_urdf(
        (DATA / "tx40_mdh_modified.urdf").read_text(encoding="utf-8"),
        friction=FrictionLaw(offset=True),
        coupling=coupling,
    )
    options = Preprocessing(smooth_torque=True, torque_bandwidth=40.0)
    samples = prepare(recording, model, options=options)
    found = estimate(model, Factor.of(model, samples), np.ones(6))
    (error,) = prediction_error(model, found.values, [samples], all_rows=True)
    return found, error


def test_the_coupling_explains_what_its_rivals_say_it_does(recording: Recording) -> None:
    """Comparators, with linear friction: 10.9 % with, 14.3 % without; joint 5: 19 %, 53 %."""
    _, without = fitted(recording, None)
    _, coupled = fitted(recording, Coupling(TURNS))
    assert coupled.overall <= 0.109
    assert coupled.relative[4] <= 0.19
    assert without.overall > 0.12
    assert without.relative[4] > 0.45


def test_the_coupled_motors_parameters_are_the_published_ones(recording: Recording) -> None:
    """Iam6, fsm6 and fvm6 of the YAML beside the data: 0.00964, 1.95, 0.616."""
    found, _ = fitted(recording, Coupling(TURNS))
    values = dict(zip(found.names, found.values, strict=True))
    assert values["I56"] == pytest.approx(0.00964, rel=0.05)
    assert values["f0_m6"] == pytest.approx(1.95, rel=0.05)
    assert values["f1_m6"] == pytest.approx(0.616, rel=0.05)
