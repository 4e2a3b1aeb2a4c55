"""What a torque is other than that of the described arm: of no bodies, no gravity, other zeros."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from identification import Recording, RobotModel
from identification.estimators.prior import body_prior, posterior_values
from identification.factor.factor import Factor
from identification.hypotheses.column_search import find_columns, find_columns_of_unseen
from identification.hypotheses.diagnosis import UNEXPLAINED, TorqueDiagnosis, diagnose
from identification.hypotheses.explanation import ExplainedFit, Explanation
from identification.hypotheses.joint_changes import Change
from identification.hypotheses.readings import Adequacy
from identification.hypotheses.scores import ROWS_PER_FACT
from identification.hypotheses.search import find_readings
from identification.model.motion import Motion
from identification.signals.samples import Preprocessing, prepare
from identification.validation.findings.diagnosis import of_diagnosis
from tests.identification.robots import robot_text
from tests.identification.three_axes import HIP, KNEE, NAMES, TIME, model, motion

Floats = NDArray[np.float64]


def diagnosed(position: Floats, torque: Floats, time: Floats = TIME) -> TorqueDiagnosis:
    recording = Recording(time, position, NAMES, torque)
    options = Preprocessing(14.0, exclude_rows="rests")
    return diagnose(model(), [prepare(recording, model(), options=options)])


def friction() -> Floats:
    """The friction of `motion`, with noise."""
    q, _, _ = motion()
    velocity = np.gradient(q, TIME, axis=0)
    noise = np.random.default_rng(1).normal(0.0, 0.02, q.shape)
    return np.asarray(0.4 * np.sign(velocity) + 0.2 * velocity + noise)


def test_an_arm_as_described_is_nothing_else() -> None:
    found = diagnosed(*motion()[:2])
    assert not found.rigid.is_nothing
    assert not found.is_weightless
    assert not found.zeros


def test_what_a_subtracted_model_leaves_is_not_of_bodies() -> None:
    q, torque, _ = motion()
    left = 4.0 * friction() + 0.03 * (torque - friction())
    found = diagnosed(q, left)
    assert found.rigid.is_nothing
    assert found.readings is None


def test_torque_of_something_else_is_not_called_friction() -> None:
    q, _, _ = motion()
    noise = np.random.default_rng(2).normal(0.0, 1.0, q.shape)
    assert not diagnosed(q, noise).rigid.is_nothing


@pytest.mark.parametrize("ratio", [50.0, 160.0])
def test_torque_of_the_motor_side_is_of_bodies(ratio: float) -> None:
    """It is as small, but as much of it is of friction as on the joint side."""
    q, torque, _ = motion()
    found = diagnosed(q, torque / ratio)
    assert found.rigid.scale == pytest.approx(1.0 / ratio, rel=0.1)
    assert not found.rigid.is_nothing


def test_removed_gravity_is_seen() -> None:
    q, torque, weight = motion()
    found = diagnosed(q, torque - weight)
    assert found.is_weightless
    assert not found.rigid.is_nothing


@pytest.mark.parametrize("left", [0.1, -0.1])
def test_gravity_removed_by_another_model_is_not_all_removed(left: float) -> None:
    q, torque, weight = motion()
    found = diagnosed(q, torque - (1.0 - left) * weight)
    assert found.is_partly_weightless
    assert not found.is_weightless
    assert [each.key for each in of_diagnosis(found)] == ["part of gravity"]


def test_zeros_of_several_joints_are_seen_at_once() -> None:
    q, torque, _ = motion()
    found = diagnosed(q - 0.3 * HIP + 0.2 * KNEE, torque)
    assert {step.change.joints: step.change.size for step in found.zeros} == {
        (0,): pytest.approx(0.3, abs=0.03),
        (1,): pytest.approx(-0.2, abs=0.03),
    }
    assert all(step.sure for step in found.zeros)


@pytest.mark.parametrize(
    "more",
    [
        pytest.param(lambda q: 6.0 * np.sin(2.0 * q) * KNEE, id="a spring"),
        pytest.param(lambda q: 1.5 * np.sin(20.0 * q), id="ripple"),
    ],
)
def test_what_is_no_zero_is_called_none(more: object) -> None:
    q, torque, _ = motion()
    assert not diagnosed(q, torque + more(q)).zeros  # type: ignore[operator]


def test_rows_that_run_backwards_are_no_wrong_sign() -> None:
    """Friction drives both joints, and inertia is as it should be; not so with torques negated."""
    q, torque, _ = motion()
    found = diagnosed(q[::-1], torque[::-1])
    assert found.is_backwards
    assert not found.discrete
    negated = diagnosed(q, -torque)
    assert not negated.is_backwards
    assert [step.change.meaning for step in negated.discrete] == ["torque sign"]


def test_a_reading_is_judged_joint_by_joint() -> None:
    """A mean over the joints hides one that is ten times worse than a free fit has it."""
    assert Adequacy(1.1, 1.5, agrees=True).is_enough
    assert not Adequacy(1.1, 10.0, agrees=True).is_enough


@pytest.mark.parametrize("factor", [0.4, 0.5, 1.6, 2.0])
def test_times_that_are_too_long_or_short_are_named(factor: float) -> None:
    """Inertia and weight do not fit together then, and the weight is as described."""
    q, torque, _ = motion()
    found = diagnosed(q, torque, factor * TIME)
    assert found.time == pytest.approx(factor, rel=0.05)
    assert found.readings is None


@pytest.mark.parametrize("factors", [(1.8, 1.8, 1.8), (0.6, 0.6, 0.6), (1.0, 1.5, 2.0)])
def test_other_masses_are_no_other_times(factors: tuple[float, ...]) -> None:
    q, torque, _ = motion(factors)
    assert diagnosed(q, torque).time is None


def test_longer_links_are_no_other_times() -> None:
    """They have more inertia for their weight as well, and more weight."""
    q, torque, weight = motion()
    factor = 2.5
    heavier = factor**2 * (torque - weight) + factor * weight
    found = diagnosed(q, heavier)
    assert found.inertia is not None
    assert found.inertia.factor == pytest.approx(factor, rel=0.2)
    assert found.time is None


def test_the_rate_of_a_torque_is_named() -> None:
    q, torque, _ = motion()
    found = diagnosed(q, np.gradient(torque, TIME, axis=0))
    assert found.is_rate
    assert not diagnosed(q, torque).is_rate


def test_a_torque_of_another_run_is_explained_by_nothing() -> None:
    q, torque, _ = motion()
    assert diagnosed(q, np.roll(torque, len(TIME) // 2, axis=0)).is_unexplained
    assert not diagnosed(q, torque).is_unexplained


def each_joint_once(robot: RobotModel, load: float, duration: float = 12.0) -> Recording:
    """A torque under a load on the flange [kg]; each joint moves once, one after the other."""
    rng = np.random.default_rng(0)
    n = robot.n_joints
    time = np.arange(0.0, duration, 1.0 / 30.0)
    each = duration / n
    passed = np.clip(time[:, None] / each - np.arange(n), 0.0, 1.0)
    travel = rng.uniform(1.0, 2.0, n) * rng.choice([-1.0, 1.0], n)
    q = rng.uniform(-1.0, 1.0, n) + travel * Polynomial([0, 0, 0, 10, -15, 6])(passed)
    v = travel * Polynomial([0, 0, 30, -60, 30])(passed) / each
    a = travel * Polynomial([0, 60, -180, 120])(passed) / each**2
    bodies = robot.nominal.copy()
    names = robot.layout.names
    for symbol, lever in zip(("m6", "mc6x", "mc6y", "mc6z"), (1.0, 0.05, 0.1, 0.15), strict=True):
        bodies[names.index(symbol)] += load * lever
    values = np.zeros(robot.n_parameters)
    values[: robot.base.rank] = robot.base.grouping @ bodies
    torque = robot.torque(values, Motion.of_states(q, v, a))
    size = np.sqrt(np.mean(torque**2, axis=0))
    torque += size * (0.1 * np.sign(v) + rng.normal(0.0, 0.02, v.shape))
    return Recording(time, q, robot.joint_names, torque)


@pytest.mark.long
@pytest.mark.parametrize("load", [0.0, 15.0])
def test_masses_explain_a_log_of_which_no_part_predicts_another(load: float) -> None:
    """Under a load as heavy as the arm, the masses of the URDF do not explain it."""
    robot = RobotModel.from_urdf(robot_text("ur_description/urdf/ur5_robot.urdf"))
    recording = each_joint_once(robot, load)
    options = Preprocessing(14.0, exclude_rows="rests")

    def error(torque: Floats) -> float:
        samples = prepare(replace(recording, torque=torque), robot, options=options)
        return diagnose(robot, [samples]).error

    assert error(recording.torque) < 0.5 * UNEXPLAINED
    assert error(np.roll(recording.torque, len(recording.time) // 2, axis=0)) > UNEXPLAINED


@pytest.mark.long
@pytest.mark.parametrize("load", [5.0, 15.0])
def test_a_load_is_no_other_times(load: float) -> None:
    """Its weight is far from the axes of most joints, where nobody states its inertia."""
    robot = RobotModel.from_urdf(robot_text("ur_description/urdf/ur5_robot.urdf"))
    options = Preprocessing(14.0, exclude_rows="rests")
    samples = prepare(each_joint_once(robot, load), robot, options=options)
    assert diagnose(robot, [samples]).inertia is None


@pytest.mark.long
@pytest.mark.parametrize(("load", "duration", "hangs"), [(0.0, 12.0, True), (10.0, 60.0, False)])
def test_an_arm_under_a_load_is_not_certain_to_hang(
    load: float, duration: float, hangs: bool
) -> None:
    """In slow motion, the load's weight is that of the described arm upside down."""
    described = RobotModel.from_urdf(robot_text("ur_description/urdf/ur5_robot.urdf"))
    hanging = described.under_gravity((0.0, 0.0, 9.81))
    recording = each_joint_once(hanging if hangs else described, load, duration)
    samples = prepare(recording, described, options=Preprocessing(14.0, exclude_rows="rests"))
    found = find_readings(described, samples, mountings={"upside down": hanging})
    steps = [step for step in found.steps if step.change.meaning == "mounting"]
    assert any(step.sure for step in steps) == hangs


def test_what_is_known_is_not_searched_again() -> None:
    q, torque, _ = motion()
    known = diagnosed(q - 0.3 * HIP, torque)
    options = Preprocessing(14.0, exclude_rows="rests")
    samples = prepare(Recording(TIME, q, NAMES, torque), model(), options=options)
    assert diagnose(model(), [samples], known=known) is known


@pytest.mark.parametrize("size", [-0.05, 0.2])
def test_a_zero_that_drifts_is_named(size: float) -> None:
    """And no other change of a part, such as of a torque's scale or of the arm."""
    q, torque, _ = motion()
    passed = (TIME / TIME[-1])[:, None]
    recording = Recording(TIME, q - size * passed * KNEE, NAMES, torque)
    samples = prepare(recording, model(), options=Preprocessing(14.0, exclude_rows="rests"))
    factor = Factor.of(model(), samples)
    values, _ = posterior_values(factor, body_prior(model(), factor).gaussian, ROWS_PER_FACT)
    (found,) = find_columns(model(), [samples], ExplainedFit(values))
    assert found.change == Change("drift", (1,))
    assert found.size == pytest.approx(size, rel=0.15)


def test_a_log_without_drift_has_none() -> None:
    q, torque, _ = motion()
    samples = prepare(
        Recording(TIME, q, NAMES, torque),
        model(),
        options=Preprocessing(14.0, exclude_rows="rests"),
    )
    factor = Factor.of(model(), samples)
    values, _ = posterior_values(factor, body_prior(model(), factor).gaussian, ROWS_PER_FACT)
    assert not find_columns(model(), [samples], ExplainedFit(values))


@pytest.mark.parametrize(
    ("start", "end", "scales"),
    [(0.5, 1.0, (1.0, 1.0, 1.0)), (0.3, 0.7, (1.0, 1.0, 1.0)), (0.5, 1.0, (1.0, 1.6, 1.0))],
)
def test_a_load_in_a_part_is_no_scale_of_a_torque(
    start: float, end: float, scales: tuple[float, ...]
) -> None:
    """A scale throughout is found with it; the load has the mass of the last body, 1 kg."""
    q, bare, _ = motion()
    loaded = motion((1.0, 1.0, 2.0))[1]
    share = TIME / TIME[-1]
    torque = np.where(((start <= share) & (share <= end))[:, None], loaded, bare) * scales
    recording = Recording(TIME, q, NAMES, torque)
    samples = prepare(recording, model(), options=Preprocessing(14.0, exclude_rows="rests"))
    factor = Factor.of(model(), samples)
    values, _ = posterior_values(factor, body_prior(model(), factor).gaussian, ROWS_PER_FACT)
    load, *others = find_columns(model(), [samples], ExplainedFit(values))
    assert load.change.meaning == "payload"
    assert load.change.part is not None
    until = "on" if end == 1.0 else f"to {end * TIME[-1]:.1f} s"
    assert load.change.part.name == f"recording 1 from {start * 6.0:.3g} s {until}"
    assert load.size == pytest.approx(1.0, abs=0.01)
    found = {each.change.joints: each.size for each in others}
    assert found == {(j,): pytest.approx(s - 1.0, abs=0.01) for j, s in enumerate(scales) if s > 1}


def explanations(torque: Floats, unseen_from: float | None = None) -> tuple[Explanation, ...]:
    """Return what explains the errors of a fit of a torque, or of its rows before a share."""
    q, _, _ = motion()
    rows = len(TIME) if unseen_from is None else round(unseen_from * len(TIME))
    seen, *unseen = (
        prepare(
            Recording(TIME[part], q[part], NAMES, torque[part]),
            model(),
            options=Preprocessing(14.0, exclude_rows="rests"),
        )
        for part in (slice(0, rows), slice(rows, None))
        if part.start < len(TIME)
    )
    factor = Factor.of(model(), seen)
    values, _ = posterior_values(factor, body_prior(model(), factor).gaussian, ROWS_PER_FACT)
    if unseen:
        return find_columns_of_unseen(model(), [seen], unseen, ExplainedFit(values))
    return find_columns(model(), [seen], ExplainedFit(values))


def within(start: float, end: float = 1.0) -> NDArray[np.bool_]:
    """Rows between two shares of the time (m, 1)."""
    share = TIME / TIME[-1]
    return np.asarray(((start <= share) & (share <= end))[:, None])


def dry_and_viscous() -> Floats:
    """The friction of `motion`, without noise."""
    velocity = np.gradient(motion()[0], TIME, axis=0)
    return np.asarray(0.4 * np.sign(velocity) + 0.2 * velocity)


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_a_load_with_another_scale_of_its_part_is_not_certain(joint: int) -> None:
    """A load alone has a wrong mass; that it is not alone is named."""
    factors = np.where(np.arange(3) == joint, 1.4, 1.0)
    bare, loaded = motion()[1], motion((1.0, 1.0, 2.0))[1]
    found, *more = explanations(np.where(within(0.3, 0.7), loaded * factors, bare))
    assert not more
    assert not found.is_certain
    kinds = [{(each.meaning, each.joints) for each in rival} for rival in found.rivals]
    assert any({("payload", ()), ("scale", (joint,))} <= rival for rival in kinds)


@pytest.mark.parametrize("start", [0.5, 0.3])
def test_a_load_alone_is_certain(start: float) -> None:
    (found,) = explanations(np.where(within(start), motion((1.0, 1.0, 2.0))[1], motion()[1]))
    assert found.change.meaning == "payload"
    assert found.is_certain


@pytest.mark.parametrize("joint", [0, 1, 2])
def test_a_load_with_a_scale_throughout_is_certain(joint: int) -> None:
    """No other joint's scale explains as much with another mass."""
    factors = np.where(np.arange(3) == joint, 1.2, 1.0)
    noise = np.random.default_rng(joint).normal(0.0, 0.1, (len(TIME), 3))
    torque = np.where(within(0.6), motion((1.0, 1.0, 2.0))[1], motion()[1]) * factors + noise
    load, gain = explanations(torque)
    assert load.is_certain
    assert load.size == pytest.approx(1.0, abs=0.01)
    assert gain.change == Change("scale", (joint,))
    assert gain.size == pytest.approx(0.2, abs=0.01)


def test_friction_of_a_joint_from_a_time_on_is_certain() -> None:
    more = np.where(within(0.5), 0.5 * dry_and_viscous() * KNEE, 0.0)
    (found,) = explanations(motion()[1] + more)
    assert found.change[:2] == ("friction", (1,))
    assert found.size == pytest.approx(0.5, abs=0.02)
    assert found.is_certain


@pytest.mark.parametrize("rise", [0.6, 1.2])
def test_friction_that_drifts_is_no_certain_step(rise: float) -> None:
    """Neither in what is fitted nor in unseen motion."""
    passed = (TIME / TIME[-1])[:, None]
    (found,) = explanations(motion()[1] + rise * passed * dry_and_viscous())
    assert not found.is_certain
    assert found.rivals[0] == (Change("friction drift", (0, 1, 2)),)
    later = np.maximum(passed - 0.5, 0.0)
    (begun,) = explanations(motion()[1] + 2.0 * rise * later * dry_and_viscous(), 0.5)
    assert not begun.is_certain
    assert "friction drift" in {each.meaning for rival in begun.rivals for each in rival}


HALF = len(TIME) // 2


@cache
def two_motions(factors: tuple[float, ...] = (1.0, 1.0, 1.0)) -> tuple[Floats, Floats]:
    """Positions and torques of a motion, and of a smaller and faster one in the second half.

    Each `factor` multiplies all parameters of one body, in the second half only.
    """
    later = within(0.5)
    phase = np.cumsum(np.where(later, 1.6, 1.0), axis=0) * TIME[1]
    rate = np.array([[2.0, 5.1], [3.3, 6.2], [2.7, 7.4]])
    shape = np.sin(rate * phase[..., None] + np.arange(6.0).reshape(3, 2)).sum(axis=2)
    q = 0.4 * np.where(later, 0.6, 1.0) * shape
    v = np.gradient(q, TIME, axis=0)
    states = Motion.of_states(q, v, np.gradient(v, TIME, axis=0))
    robot = model()
    values = np.zeros((2, robot.n_parameters))
    for row, factor in zip(values, ((1.0, 1.0, 1.0), factors), strict=True):
        bodies = np.repeat(factor, robot.layout.width) * robot.nominal
        row[: robot.base.rank] = robot.base.grouping @ bodies
    before, after = (robot.torque(row, states) for row in values)
    return q, np.where(later, after, before) + 0.4 * np.sign(v) + 0.2 * v


def of_three_runs_each(position: Floats, torque: Floats) -> tuple[Explanation, ...]:
    """Return what explains the errors of a fit of both halves, recorded three times each."""
    options = Preprocessing(14.0, exclude_rows="rests")
    rng = np.random.default_rng(1)
    runs = []
    for part in (*[slice(0, HALF)] * 3, *[slice(HALF, None)] * 3):
        noisy = torque[part] + rng.normal(0.0, 0.02, (HALF, 3))
        run = Recording(TIME[:HALF], position[part], NAMES, noisy)
        runs.append(prepare(run, model(), options=options))
    factor = Factor.of(model(), prepare(Recording(TIME, position, NAMES, torque), model()))
    values, _ = posterior_values(factor, body_prior(model(), factor).gaussian, ROWS_PER_FACT)
    return find_columns(model(), runs, ExplainedFit(values, noise=np.full(3, 0.03)))


def test_what_the_model_lacks_is_no_certain_arm() -> None:
    """Two motions show different parts of a ripple, which parameters of their own fit better."""
    q, torque = two_motions()
    (found,) = of_three_runs_each(q, torque + 0.05 * np.sin(5.0 * q))
    assert found.change.meaning == "arm"
    assert found.rivals == ((Change("unmodelled"),),)
    assert not found.is_certain


@pytest.mark.parametrize("factors", [(2.0, 2.0, 0.5), (1.0, 1.5, 1.0)])
def test_another_arm_is_certain(factors: tuple[float, ...]) -> None:
    """Even if both lack a ripple in the model."""
    q, torque = two_motions(factors)
    (found,) = of_three_runs_each(q, torque + 0.5 * np.sin(5.0 * q))
    assert found.change.meaning == "arm"
    assert found.is_certain
