"""Faults are found by mending them: planted ones by name, none in sound recordings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.typing import NDArray

from identification.factor.factor import Factor, estimate, total
from identification.model.motion import Motion
from identification.model.robot import RobotModel
from identification.signals.samples import Samples
from identification.validation.causes import Causes, find_causes
from sim_fixtures.ns16 import urdf_text
from tests.identification.two_link import as_samples, sine_motion

Array = NDArray[np.float64]

ROTORS = [7.6465, 24.5955, 10.48, 0.253, 0.298, 0.12]
COULOMB = [68.035, 108.777, 50.446, 9.248, 8.904, 5.148]
VISCOUS = [41.196, 63.255, 39.248, 3.2659, 16.4439, 8.8808]
NOISE = 0.02  # of each joint's torque
LOAD = 6.0  # kg
DELAY = 0.02  # s
SLOW = 0.2  # rad/s; rows near a reversal are left out


@pytest.fixture(scope="module")
def model() -> RobotModel:
    return RobotModel.from_urdf(urdf_text())


def moved(seed: int) -> Motion:
    """Ten seconds of three sines on each joint."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 10.0, 8e-3)
    centre = np.array([0.0, -1.2, 2.0, 0.0, 0.0, 0.0])
    amplitude = np.array([0.7, 0.25, 0.5, 1.2, 0.7, 1.5]) * rng.uniform(0.5, 1.0, (3, 6))
    rate = np.array([1.6, 2.4, 2.2, 2.0, 2.6, 2.4]) * rng.uniform(0.4, 1.3, (3, 6))
    return sine_motion(time, amplitude, rate, rng.uniform(0.0, 2.0 * np.pi, (3, 6)), centre)


def recorded(model: RobotModel, seed: int, load: Array | None = None) -> Samples:
    """A motion with the torques of the paper's arm, a load (m,) [kg] on its flange, and noise."""
    motion = moved(seed)
    standard = model.nominal.reshape(6, -1).copy()
    standard[:, -1] = ROTORS
    values = np.concatenate([model.base.grouping @ standard.ravel(), COULOMB, VISCOUS, np.zeros(6)])
    torque = model.torque(values, *motion[1:])
    if load is not None:
        torque = torque + load[:, None] * of_one_kilogram(motion)
    rng = np.random.default_rng(seed + 1000)
    torque = torque + NOISE * torque.std(axis=0) * rng.standard_normal(torque.shape)
    return as_samples(model, motion, torque, usable=np.abs(motion.velocity) > SLOW)


def of_one_kilogram(motion: Motion) -> Array:
    """Torque by pinocchio of a sphere of 1 kg, 10 cm in front of the last joint."""
    bare = pin.buildModelFromXML(urdf_text())
    loaded = bare.copy()
    body = pin.Inertia.FromSphere(1.0, 0.05)
    loaded.inertias[6] += body.se3Action(pin.SE3(np.eye(3), np.array([0.0, 0.0, 0.1])))
    data = bare.createData(), loaded.createData()
    rows = zip(*motion[1:4], strict=True)
    return np.array(
        [pin.rnea(loaded, data[1], *row) - pin.rnea(bare, data[0], *row) for row in rows]
    )


def causes(model: RobotModel, recordings: Sequence[Samples]) -> Causes:
    values = estimate(model, total([Factor.of(model, one) for one in recordings])).values
    return find_causes(model, recordings, values, [f"{k}.mcap" for k in range(len(recordings))])


def late(samples: Samples) -> Samples:
    time = samples.motion.time
    return replace(
        samples,
        torque=np.column_stack([np.interp(time - DELAY, time, one) for one in samples.torque.T]),
    )


def swapped(values: Array) -> Array:
    return values[:, [0, 2, 1, 3, 4, 5]]


def with_other_motion(samples: Samples, change: Callable[[Array], Array]) -> Samples:
    motion = samples.motion
    return replace(samples, motion=Motion(motion.time, *(change(one) for one in motion[1:4])))


SIGN = np.array([1.0, 1.0, -1.0, 1.0, 1.0, 1.0])
GAIN = np.array([1.0, 1.15, 1.0, 1.0, 1.0, 1.0])
FAULTS: dict[str, tuple[tuple[int, ...], Callable[[Samples], Samples]]] = {
    "delay": ((), late),
    "gain": ((1,), lambda one: replace(one, torque=GAIN * one.torque)),
    "torque sign": ((2,), lambda one: replace(one, torque=SIGN * one.torque)),
    "torque order": ((1, 2), lambda one: replace(one, torque=swapped(one.torque))),
    "axis sign": (
        (2,),
        lambda one: replace(
            with_other_motion(one, lambda part: SIGN * part), torque=SIGN * one.torque
        ),
    ),
    "position order": ((1, 2), lambda one: with_other_motion(one, swapped)),
    "joint order": (
        (1, 2),
        lambda one: replace(
            with_other_motion(one, swapped), torque=swapped(one.torque), usable=swapped(one.usable)
        ),
    ),
}


class TestCausesOfWholeRecordings:
    """What is wrong throughout."""

    @pytest.mark.parametrize("seed", range(8))
    def test_sound_recordings_have_none(self, model: RobotModel, seed: int) -> None:
        assert causes(model, [recorded(model, seed)]).found == ()

    @pytest.mark.parametrize("kind", FAULTS)
    @pytest.mark.parametrize("seed", [1, 2])
    def test_a_fault_is_named_and_nothing_else(
        self, model: RobotModel, kind: str, seed: int
    ) -> None:
        joints, spoil = FAULTS[kind]
        found = causes(model, [spoil(recorded(model, seed))]).found
        assert [(one.fault.kind, one.fault.joints) for one in found] == [(kind, joints)]

    def test_sizes_lie_within_four_deviations(self, model: RobotModel) -> None:
        for kind, size in (("delay", DELAY), ("gain", 0.15)):
            (cause,) = causes(model, [FAULTS[kind][1](recorded(model, 1))]).found
            assert cause.size == pytest.approx(size, abs=4.0 * cause.std + 0.02 * size)

    def test_two_faults_are_found_one_after_the_other(self, model: RobotModel) -> None:
        both = FAULTS["torque sign"][1](late(recorded(model, 1)))
        found = causes(model, [both]).found
        assert {one.fault.kind for one in found} == {"torque sign", "delay"}


class TestCausesOfParts:
    """What is wrong in some of the recordings only."""

    def test_load_in_the_second_half_is_weighed(self, model: RobotModel) -> None:
        load = LOAD * (np.arange(1250) >= 625)
        (cause,) = causes(model, [recorded(model, 1, load)]).found
        assert cause.fault.kind == "payload"
        assert cause.fault.part is not None
        assert cause.fault.part.words == "0.mcap from 5 s on"
        assert cause.size == pytest.approx(LOAD, abs=4.0 * cause.std + 0.1)

    def test_load_in_two_of_four_recordings(self, model: RobotModel) -> None:
        load = np.full(1250, LOAD)
        runs = [recorded(model, k, load if k in (1, 3) else None) for k in range(4)]
        (cause,) = causes(model, runs).found
        assert cause.fault.kind == "payload"
        assert cause.fault.part is not None and cause.fault.part.words == "1.mcap, 3.mcap"
        assert cause.size == pytest.approx(LOAD, abs=4.0 * cause.std + 0.1)

    def test_friction_of_one_recording(self, model: RobotModel) -> None:
        runs = [recorded(model, k) for k in range(3)]
        velocity = runs[1].motion.velocity[:, 1]
        torque = runs[1].torque.copy()
        torque[:, 1] += 0.4 * (COULOMB[1] * np.sign(velocity) + VISCOUS[1] * velocity)
        runs[1] = replace(runs[1], torque=torque)
        (cause,) = causes(model, runs).found
        assert (cause.fault.kind, cause.fault.joints) == ("changed friction", (1,))
        assert cause.fault.part is not None and cause.fault.part.words == "1.mcap"
        assert cause.size == pytest.approx(0.4, abs=0.05)

    def test_another_arm_in_the_second_half(self, model: RobotModel) -> None:
        runs = [recorded(model, k) for k in range(4)]
        scale = np.array([1.4, 0.8, 1.3, 0.7, 1.5, 0.8])
        runs[2:] = [replace(one, torque=scale * one.torque) for one in runs[2:]]
        first = causes(model, runs).found[0]
        assert first.fault.kind == "changed arm"
        assert first.fault.part is not None
        assert first.fault.part.words == "2.mcap and what follows it"
