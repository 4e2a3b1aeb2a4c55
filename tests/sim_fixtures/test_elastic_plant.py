"""Springs in the gears: static deflection, energy, the rigid limit."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from sim_fixtures import ElasticPlant, Plant, PlantTruth, SettingError, ns16

START = np.array([0.2, -1.2, 2.5, 0.3, 1.0, 0.2])
STEP = 5e-4
SOFT = (1.0e-6, 1.0e-6, 2.5e-6, 0.0, 0.0, 0.0)


def elastic(truth: PlantTruth, compliance: tuple[float, ...] = SOFT) -> ElasticPlant:
    return ElasticPlant(ns16.urdf_text(), truth, elasticity=compliance, step=STEP, position=START)


def test_springs_carry_gravity_from_the_start(truth: PlantTruth) -> None:
    plant = elastic(truth)
    gravity = pin.computeGeneralizedGravity(plant.model, plant.model.createData(), START)
    np.testing.assert_allclose(plant.motor_position - START, gravity * SOFT, atol=1e-15)
    for _ in range(200):
        plant.step(gravity, STEP)
    np.testing.assert_allclose(plant.position, START, atol=1e-9)


def test_only_elastic_axes_deflect(truth: PlantTruth) -> None:
    plant = elastic(truth)
    rng = np.random.default_rng(1)
    for _ in range(300):
        plant.step(rng.normal(size=6) * 300.0, STEP)
    stretch = plant.motor_position - plant.position
    np.testing.assert_array_equal(stretch[3:], 0.0)
    assert np.all(np.abs(stretch[:3]) > 1e-6)


def test_a_stiff_gear_is_a_rigid_one(truth: PlantTruth) -> None:
    stiff = elastic(truth, (5e-8, 5e-8, 0.0, 0.0, 0.0, 0.0))
    rigid = Plant(ns16.urdf_text(), truth, position=START)
    for k in range(1000):
        torque = np.array([900.0, -300.0, 0.0, 5.0, 15.0, 8.0]) * np.sin(0.01 * k)
        stiff.step(torque, STEP)
        rigid.step(torque, STEP)
    assert np.abs(rigid.velocity).max() > 0.3
    np.testing.assert_allclose(stiff.velocity, rigid.velocity, atol=2e-2)
    np.testing.assert_allclose(stiff.position, rigid.position, atol=2e-3)


def test_damped_springs_lose_energy_and_never_gain_it(frictionless: PlantTruth) -> None:
    plant = elastic(frictionless)
    start = plant.energy()
    energies = []
    for _ in range(2000):
        plant.step(np.zeros(6), STEP)
        energies.append(plant.energy())
    assert plant.velocity @ plant.velocity > 1.0  # it did swing
    assert max(energies) < start + 0.01  # J; of some hundred in motion
    assert start - 20.0 < energies[-1] < start


def test_a_struck_link_rings_at_the_frequency_of_its_spring(truth: PlantTruth) -> None:
    """Motor held by its brake, link free: an oscillator with the link's own inertia."""
    plant = ElasticPlant(
        ns16.urdf_text(), truth, elasticity=(1e-6, 0.0, 0.0, 0.0, 0.0, 0.0), step=STEP,
        position=START, brake_torque=1e5,
    )  # fmt: skip
    plant.close_brakes(True)
    plant.set_state(START, [0.01, 0.0, 0.0, 0.0, 0.0, 0.0])
    swing = []
    for _ in range(1000):
        plant.step(np.zeros(6), STEP)
        swing.append(plant.position[0] - START[0])
    inertia = pin.crba(plant.model, plant.model.createData(), START)[0, 0]
    crossings = np.nonzero(np.diff(np.sign(swing)) != 0)[0]
    period = 2.0 * np.mean(np.diff(crossings)) * STEP
    assert 2.0 * np.pi / period == pytest.approx(np.sqrt(1e6 / inertia), rel=0.02)


@pytest.mark.parametrize(
    ("compliance", "message"),
    [
        ((0.0,) * 6, "compliances"),
        ((1e-6,) * 5, "compliances"),
        ((0.0, 0.0, 0.0, 0.0, 0.0, 1e-8), "resonances below"),
    ],
)
def test_springs_that_cannot_be_integrated_are_refused(
    truth: PlantTruth, compliance: tuple[float, ...], message: str
) -> None:
    with pytest.raises(SettingError, match=message):
        elastic(truth, compliance)
