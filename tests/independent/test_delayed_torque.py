"""Delayed torque, on recordings made without code of the project: pinocchio, numpy and scipy only.

Only the NS 16's URDF is shared, so that errors of the project's model, smoothing or sampling are
not reproduced.
"""

from dataclasses import dataclass, replace
from functools import partial
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
import scipy
from numpy.typing import NDArray

from identification.estimators.delay import estimate_delay, rate_products, with_uncertain_delay
from identification.estimators.least_squares import fit_least_squares
from identification.factor.factor import Factor
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.selection.questions import SuggestedDelay, choose_settings
from identification.selection.settings import Settings
from identification.signals.recording import Recording
from identification.signals.samples import Preprocessing, prepare

pytestmark = pytest.mark.long

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[2]


@dataclass(frozen=True, eq=False)
class SimulatedArm:
    """A rigid arm of n joints with rotors and dry and viscous friction."""

    urdf: str
    model: pin.Model  # with rotor inertias as armature
    locked: dict[str, float]  # positions of joints of the URDF that do not belong to the arm
    speed: Array  # largest joint speeds (n,) [rad/s]
    centre: Array  # posture about which it moves (n,) [rad]
    room: Array  # largest excursion from there (n,) [rad]
    coulomb: Array  # (n,) [N·m]
    viscous: Array  # (n,) [N·m·s/rad]

    @property
    def joint_names(self):
        return tuple(self.model.names[1:])

    def torque(self, q, qd, qdd):
        """Joint torque (m, n) [N·m]."""
        data = self.model.createData()
        rigid = np.array([pin.rnea(self.model, data, *row) for row in zip(q, qd, qdd, strict=True)])
        return rigid + self.coulomb * np.tanh(qd / 1e-3) + self.viscous * qd


def ns16():
    """Return a COMAU NS 16, with more friction than inertia in the wrist."""
    urdf = (ROOT / "sim_fixtures" / "ns16" / "ns16.urdf").read_text(encoding="utf-8")
    model = pin.buildModelFromXML(urdf)
    model.armature = np.array([7.6, 24.6, 10.5, 0.25, 0.30, 0.12])
    return SimulatedArm(
        urdf=urdf,
        model=model,
        locked={},
        speed=np.array([2.7, 2.7, 2.9, 6.2, 6.1, 9.5]),
        centre=np.array([0.0, -1.2, 2.0, 0.0, 1.0, 0.0]),
        room=np.array([1.5, 0.7, 0.9, 2.0, 0.9, 2.5]),
        coulomb=np.array([68.0, 108.0, 50.0, 9.2, 8.9, 5.1]),
        viscous=np.array([41.0, 63.0, 39.0, 3.3, 16.4, 8.9]),
    )


def panda():
    """Return a Franka Emika Panda without fingers; skips without its description."""
    try:
        package = distribution("example-robot-data")
    except PackageNotFoundError:
        pytest.skip("the example-robot-data package is not installed")
    path = "cmeel.prefix/share/example-robot-data/robots/panda_description/urdf/panda.urdf"
    urdf = Path(str(package.locate_file(path))).read_text(encoding="utf-8")
    whole = pin.buildModelFromXML(urdf)
    fingers = ("panda_finger_joint1", "panda_finger_joint2")
    held = [whole.getJointId(name) for name in fingers]
    model = pin.buildReducedModel(whole, held, pin.neutral(whole))
    model.armature = np.array([0.6, 0.6, 0.5, 0.5, 0.2, 0.2, 0.2])
    return SimulatedArm(
        urdf=urdf,
        model=model,
        locked=dict.fromkeys(fingers, 0.0),
        speed=np.array([2.17, 2.17, 2.17, 2.17, 2.6, 2.6, 2.6]),
        centre=np.array([0.0, 0.0, 0.0, -1.6, 0.0, 1.8, 0.0]),
        room=np.array([1.5, 1.2, 1.5, 1.2, 1.5, 1.4, 1.5]),
        coulomb=np.array([0.8, 0.9, 0.7, 0.8, 0.6, 0.4, 0.5]),
        viscous=np.array([1.2, 1.4, 1.0, 1.1, 0.6, 0.5, 0.4]),
    )


def sines(time, centre, size, rate, phase):
    """Position, velocity and acceleration (m, n) of sums of sines; size, rate, phase (k, n)."""
    angle = rate * time[:, None, None] + phase
    wave = size * np.sin(angle)
    slope = (size * rate * np.cos(angle)).sum(axis=1)
    return centre + wave.sum(axis=1), slope, -(wave * rate**2).sum(axis=1)


def motion(arm, seed, pace):
    """Return five sines per joint, 0.1 to 1 Hz at pace 1, up to 60 % of the largest speeds."""
    rng = np.random.default_rng([seed, 1])
    shape = (5, len(arm.centre))
    rate = 2.0 * np.pi * rng.uniform(0.1, 1.0, shape)
    size = rng.standard_normal(shape) / rate
    phase = rng.uniform(0.0, 2.0 * np.pi, shape)
    q, qd, _ = sines(np.arange(0.0, 60.0, 0.01), arm.centre, size, rate, phase)
    fastest = np.abs(qd).max(axis=0) / (0.6 * arm.speed)
    farthest = np.abs(q - arm.centre).max(axis=0) / arm.room
    size /= np.maximum(fastest, farthest)
    return partial(sines, centre=arm.centre, size=size, rate=pace * rate, phase=phase)


def recorded(arm, seed, noise, delay, pace):
    """Half a minute at 250 Hz, the torque logged a delay [s] later.

    The noise of the torque has a standard deviation of 1.4 % of that of the torque; it is white,
    or half of its power autoregressive with 50 ms.
    """
    rate = 250.0
    moves = motion(arm, seed, pace)
    rng = np.random.default_rng([seed, 2])
    time = np.arange(7500) / rate
    torque = arm.torque(*moves(time - delay))
    draw = rng.standard_normal(torque.shape)
    if noise == "coloured":
        keep = np.exp(-1.0 / (0.05 * rate))
        slow = scipy.signal.lfilter(
            [np.sqrt(1.0 - keep**2)], [1.0, -keep], rng.standard_normal(torque.shape), axis=0
        )
        draw = np.sqrt(0.5) * (draw + slow)
    torque += 0.014 * torque.std(axis=0) * draw
    position = moves(time)[0] + 1e-5 * rng.standard_normal(torque.shape)
    return Recording(time, position, arm.joint_names, torque=torque)


def with_stribeck_friction(arm, moves, time, recording):
    """Two fifths of Coulomb friction more at rest, which falls to a third at 0.1 rad/s."""
    velocity = moves(time)[1]
    more = 0.4 * arm.coulomb * np.exp(-np.abs(velocity) / 0.1) * np.tanh(velocity / 1e-3)
    return replace(recording, torque=recording.torque + more)


def friction(arm, moves, time):
    velocity = moves(time)[1]
    return arm.coulomb * np.tanh(velocity / 1e-3) + arm.viscous * velocity


def with_drift(arm, moves, time, recording):
    """Friction that grows by 10 %."""
    more = 0.1 * (time / time[-1] - 0.5)[:, None] * friction(arm, moves, time)
    return replace(recording, torque=recording.torque + more)


def with_jump(arm, moves, time, recording):
    """Friction that is 30 % larger in the second half."""
    more = 0.3 * (time > time.mean())[:, None] * friction(arm, moves, time)
    return replace(recording, torque=recording.torque + more)


def with_encoder_zero(arm, moves, time, recording):
    """The third joint's encoder off by 0.05 rad."""
    position = recording.position.copy()
    position[:, 2] += 0.05
    return replace(recording, position=position)


def spoilt(arm, seed, delay, spoil):
    """Return a recording with a fault."""
    recording = recorded(arm, seed, "coloured", delay, BRISK)
    return spoil(arm, motion(arm, seed, BRISK), recording.time - delay, recording)


ARMS = {"NS 16": ns16, "Panda": panda}
DELAYS = [0.0, 0.0013, 0.004, 0.01]  # s
NEAR = 0.3e-3  # s
BRISK, SLOW = 1.3, 0.05  # pace; at 1.3 the NS 16 is at its acceleration limits
SEEDS = 20


def model_of(arm):
    return RobotModel.from_urdf(arm.urdf, locked=arm.locked, friction=FrictionLaw(third=None))


def coverage(arm, model, recording, delay):
    """Return the share of parameters in their 95 % intervals, with the delay compensated."""
    standard = model.nominal
    standard[10::11] = arm.model.armature
    truth = np.concatenate([model.base.grouping @ standard, arm.coulomb, arm.viscous])
    # Rows at a reversal depend on presliding.
    options = Preprocessing(torque_delay=delay.applied, exclude_rows="slow")
    samples = prepare(recording, model, options=options)
    phase = Factor.by_time(model, samples)
    fitted = fit_least_squares(model, [samples], factor=phase)
    products = rate_products(model, samples)
    fitted = with_uncertain_delay(fitted, phase, products, delay.variance)
    determined = np.isfinite(fitted.std)
    inside = np.abs(fitted.values - truth) <= fitted.interval_factor * fitted.std
    return float(np.mean(inside[determined]))


class TestDelayOfABriskMotion:
    @pytest.mark.parametrize(
        ("name", "noise", "delay"),
        [
            ("NS 16", "white", 0.0),
            ("NS 16", "coloured", 0.0013),
            ("Panda", "coloured", 0.004),
            ("NS 16", "coloured", 0.01),
        ],
    )
    def test_it_is_found(self, name, noise, delay):
        arm = ARMS[name]()
        estimate = estimate_delay(recorded(arm, 0, noise, delay, BRISK), model_of(arm))
        assert estimate.determined
        assert estimate.delay == pytest.approx(delay, abs=NEAR)
        assert estimate.significant == (delay > 0.0)

    @pytest.mark.slow
    @pytest.mark.parametrize("name", ARMS)
    @pytest.mark.parametrize("noise", ["white", "coloured"])
    @pytest.mark.parametrize("delay", DELAYS)
    def test_it_is_found_and_intervals_cover(self, name, noise, delay):
        """Within 0.3 ms in 19 of 20 runs; 95 % intervals of parameters cover 93 to 98 %."""
        arm = ARMS[name]()
        model = model_of(arm)
        near = 0
        shares = []
        for seed in range(SEEDS):
            recording = recorded(arm, seed, noise, delay, BRISK)
            estimate = estimate_delay(recording, model)
            near += estimate.determined and abs(estimate.delay - delay) < NEAR
            shares.append(coverage(arm, model, recording, estimate))
        # Within two standard errors of the share.
        share = np.mean(shares)
        unsure = 2.0 * np.std(shares, ddof=1) / np.sqrt(SEEDS)
        assert near >= 0.95 * SEEDS
        assert 0.93 - unsure < share < 0.98 + unsure


class TestDelayBesideFaults:
    """Of a model that does not know them."""

    @pytest.mark.parametrize("name", ARMS)
    @pytest.mark.parametrize("spoil", [with_stribeck_friction, with_drift, with_encoder_zero])
    @pytest.mark.parametrize("seed", [0, 1])
    def test_it_survives_them(self, name, spoil, seed):
        arm = ARMS[name]()
        estimate = estimate_delay(spoilt(arm, seed, 0.0013, spoil), model_of(arm))
        assert estimate.significant
        assert estimate.delay == pytest.approx(0.0013, abs=NEAR)

    @pytest.mark.parametrize("name", ARMS)
    @pytest.mark.parametrize("spoil", [with_stribeck_friction, with_jump, with_encoder_zero])
    @pytest.mark.parametrize("seed", [0, 1])
    def test_they_apply_none(self, name, spoil, seed):
        arm = ARMS[name]()
        estimate = estimate_delay(spoilt(arm, seed, 0.0, spoil), model_of(arm))
        assert estimate.applied == 0.0
        assert not estimate.significant

    @pytest.mark.parametrize("name", ARMS)
    @pytest.mark.parametrize("delay", [0.0, 1e-4, 2e-4, 3e-4, 4e-4])
    def test_none_is_applied_whose_interval_contains_that_assumed(self, name, delay):
        """Near the smallest delay that the motion shows."""
        arm = ARMS[name]()
        estimate = estimate_delay(recorded(arm, 2, "coloured", delay, BRISK), model_of(arm))
        contained = abs(estimate.delay - estimate.assumed) <= estimate.half_interval
        assert not (contained and estimate.applied != estimate.assumed)
        assert estimate.delay == pytest.approx(delay, abs=1.5 * estimate.half_interval)

    def test_single_joints_that_differ_widen_its_interval(self):
        """The torque of one joint is 5 ms late, which is no delay of all."""
        arm = ns16()
        recording = recorded(arm, 0, "white", 0.0, BRISK)
        alike = estimate_delay(recording, model_of(arm))
        torque = recording.torque.copy()
        time = recording.time
        torque[:, 0] = np.interp(time - 0.005, time, torque[:, 0])
        differ = estimate_delay(replace(recording, torque=torque), model_of(arm))
        assert differ.half_interval > 3.0 * alike.half_interval
        assert differ.applied == 0.0


class TestDelayBesideOtherSettings:
    @pytest.mark.slow
    @pytest.mark.parametrize("seed", [2, 3, 4])
    def test_a_presliding_displacement_does_not_replace_it(self, seed):
        """On all rows 1e-5 rad without delay predicts better than 1e-6 rad with the true one."""
        arm = ns16()
        model = model_of(arm)
        recording = recorded(arm, seed, "coloured", 0.0013, BRISK)
        estimate = estimate_delay(recording, model)

        def ready(model, how):
            return [prepare(recording, model, options=how)]

        best = choose_settings(
            model,
            ready,
            Settings(Preprocessing()),
            {"delay", "bandwidth", "presliding", "rows"},
            lambda *_: (),
            (SuggestedDelay(estimate.delay, estimate.determined),),
        )
        assert best.preprocessing.torque_delay == estimate.delay


class TestDelayOfASlowMotion:
    @pytest.mark.parametrize("name", ARMS)
    def test_it_is_not_determined(self, name):
        arm = ARMS[name]()
        estimate = estimate_delay(recorded(arm, 0, "coloured", 0.0, SLOW), model_of(arm))
        assert not estimate.determined
        assert estimate.applied == 0.0
