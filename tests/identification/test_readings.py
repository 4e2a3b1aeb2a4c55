"""Readings of a simulated recording with one meaning planted: named, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from identification import Recording
from identification.estimators.prior import TorqueSums, body_prior, body_priors
from identification.factor.columns import every_torque_factor
from identification.factor.factor import Factor
from identification.hypotheses.few_row_fits import of_torques, to_compare
from identification.hypotheses.joint_changes import (
    SIGNS,
    Axes,
    Change,
    change_of_motion,
    changed_samples,
)
from identification.hypotheses.readings import Step
from identification.hypotheses.search import find_readings
from identification.signals.samples import Preprocessing, prepare
from tests.identification.three_axes import HIP, KNEE, NAMES, TIME, model, motion
from tests.tiers import quick_ones

Floats = NDArray[np.float64]
ROTATED = [1, 2, 0]
ANGLE = 0.6  # rad
OTHER_BODIES = (1.8, 1.8, 1.8)
CASES: dict[str, tuple[Change, ...]] = {
    "as it is": (),
    "negated": (Change("torque sign", (0, 1, 2)),),
    "negated, of other bodies": (Change("torque sign", (0, 1, 2)),),
    "knee torque negated": (Change("torque sign", (1,)),),
    "knee position negated": (Change("position sign", (1,)),),
    "torques permuted": (Change("torque order", (0, 1, 2), order=(2, 0, 1)),),
    "joints permuted": (Change("joint order", (0, 1, 2), order=(2, 0, 1)),),
    "zero of the knee": (Change("zero", (1,), -ANGLE),),
    "zeros of hip and knee": (Change("zero", (0,), 0.4), Change("zero", (1,), -ANGLE)),
    "torque of the knee twice": (Change("scale", (1,), 1.0),),
    "zero of the hip, and the ankle half": (
        Change("zero", (0,), 0.4),
        Change("scale", (2,), -0.5),
    ),
    "knee torque negated, zero of the hip": (
        Change("torque sign", (1,)),
        Change("zero", (0,), 0.4),
    ),
    "gravity removed": (Change("no gravity"),),
    "knee to the ground": (Change("angle sum", (1, 0)),),
    "ankle less the knee": (Change("angle difference", (2, 1)),),
    "rods to the knee": (Change("drive sum", (1, 0)),),
    "opposite rods to the ankle": (Change("drive difference", (2, 1)),),
}


def planted(case: str) -> tuple[Floats, Floats]:
    q, torque, weight = motion()
    return {
        "as it is": (q, torque),
        "negated": (q, -torque),
        "negated, of other bodies": (q, -motion(OTHER_BODIES)[1]),
        "knee torque negated": (q, torque * (1.0 - 2.0 * KNEE)),
        "knee position negated": (q * (1.0 - 2.0 * KNEE), torque),
        "torques permuted": (q, torque[:, ROTATED]),
        "joints permuted": (q[:, ROTATED], torque[:, ROTATED]),
        "zero of the knee": (q + ANGLE * KNEE, torque),
        "zeros of hip and knee": (q - 0.4 * HIP + ANGLE * KNEE, torque),
        "torque of the knee twice": (q, torque * (1.0 + KNEE)),
        "zero of the hip, and the ankle half": (q - 0.4 * HIP, torque * [1.0, 1.0, 0.5]),
        "knee torque negated, zero of the hip": (q - 0.4 * HIP, torque * (1.0 - 2.0 * KNEE)),
        "gravity removed": (q, torque - weight),
        "knee to the ground": (q + np.roll(q, 1, axis=1) * KNEE, torque),
        "ankle less the knee": (q - np.roll(q, 1, axis=1) * [0.0, 0.0, 1.0], torque),
        "rods to the knee": (
            q + np.roll(q, 1, axis=1) * KNEE,
            torque - np.roll(torque, -1, axis=1) * HIP,
        ),
        "opposite rods to the ankle": (
            q - np.roll(q, 1, axis=1) * [0.0, 0.0, 1.0],
            torque + np.roll(torque, -1, axis=1) * KNEE,
        ),
    }[case]


QUICK = ("as it is", "zeros of hip and knee")


@pytest.mark.parametrize("case", quick_ones(QUICK, CASES))
def test_it_is_found_and_nothing_else(case: str) -> None:
    """It is certain unless it is a sign: three parallel axes have a mirror image."""
    position, torque = planted(case)
    recording = Recording(TIME, position, NAMES, torque)
    samples = prepare(recording, model(), options=Preprocessing(14.0, exclude_rows="rests"))
    gravities = {"": (0.0, 0.0, 0.0), "upside down": (0.0, 0.0, 9.81)}
    mountings = {name: model(gravity) for name, gravity in gravities.items()}
    readings = find_readings(model(), samples, mountings=mountings)
    steps = [step.change for step in readings.steps]
    expected = CASES[case]
    assert [step._replace(size=0.0) for step in steps] == [
        change._replace(size=0.0) for change in expected
    ]
    assert [step.size for step in steps] == pytest.approx(
        [change.size for change in expected], abs=0.05
    )
    assert all(step.sure != (step.change.meaning in SIGNS) for step in readings.steps)
    # The hand of the last joint is free: its zero turns with its bodies, which nothing else shows.
    assert 2 in readings.unseen_zeros


@pytest.mark.long
@pytest.mark.parametrize("joints", [(0, 1), (0, 2), (1, 2)])
def test_two_torques_without_their_sign_are_found_at_once(joints: tuple[int, ...]) -> None:
    q, torque, _ = motion()
    sign = np.where(np.isin(range(3), joints), -1.0, 1.0)
    recording = Recording(TIME, q, NAMES, torque * sign)
    samples = prepare(recording, model(), options=Preprocessing(14.0, exclude_rows="rests"))
    readings = find_readings(model(), samples)
    axes = Axes.of((step.change for step in readings.steps), 3)
    assert axes.torque_sign.tolist() == sign.tolist()
    (mirror,) = readings.rivals
    assert mirror.signs.position.tolist() == [-1.0, -1.0, -1.0]
    assert mirror.signs.torque.tolist() == (-sign).tolist()
    assert not any(step.sure for step in readings.steps)


@pytest.mark.long
@pytest.mark.parametrize(("joint", "angle"), [(0, 2.2), (1, 2.0), (1, -2.5)])
def test_a_sign_that_adds_nothing_to_a_zero_is_not_named(joint: int, angle: float) -> None:
    """A zero beyond a right angle is asked whether a sign and a nearer zero explain it as well."""
    q, torque, _ = motion()
    recording = Recording(TIME, q - angle * (np.arange(3) == joint), NAMES, torque)
    samples = prepare(recording, model(), options=Preprocessing(14.0, exclude_rows="rests"))
    (step,) = find_readings(model(), samples).steps
    assert step.is_far
    assert step.sure
    assert (step.change.meaning, step.change.joints) == ("zero", (joint,))
    assert step.change.size == pytest.approx(angle, abs=0.05)


def test_one_joint_whose_friction_alone_speaks_is_not_sure() -> None:
    """A lag of the torque looks like friction that drives the joint."""
    step = Step(Change("torque sign", (1,)), error=0.05, before=0.05, ratio=1.0, sigmas=0.0)
    assert not step.sure
    assert replace(step, ratio=0.5).sure
    assert replace(step, change=Change("torque sign", (0, 1, 2))).sure


CHANGES = [
    Change("torque order", (0, 1, 2), order=(1, 2, 0)),
    Change("torque sign", (0, 2)),
    Change("joint order", (0, 1)),
    Change("position order", (1, 2)),
    Change("axis sign", (1,)),
]


def test_sums_of_every_torque_are_those_of_each_reading() -> None:
    robot = model()
    q, torque, _ = motion()
    recording = Recording(TIME, q, NAMES, torque)
    samples = prepare(recording, robot, options=Preprocessing(14.0)).thinned(3)
    moved = [changed_samples(robot, samples, change_of_motion(change)) for change in CHANGES]
    every = every_torque_factor(robot, moved)
    blocks = [every.blocks(slice(k, k + 1)) for k in range(len(CHANGES))]
    sums = of_torques(blocks, [Axes.of([change], 3) for change in CHANGES])
    priors = body_priors(robot, sums)
    for change, gram, rows, mean, information in zip(CHANGES, *sums, *priors, strict=True):
        factor = Factor.of(robot, changed_samples(robot, samples, change))
        np.testing.assert_array_equal(rows, factor.samples)
        np.testing.assert_allclose(gram, factor.gram, rtol=1e-9, atol=1e-9 * factor.gram.max())
        prior = body_prior(robot, factor).gaussian
        np.testing.assert_allclose(mean, prior.mean, rtol=1e-9, atol=1e-12)
        size = np.sqrt(prior.information.diagonal())
        scaled = (information - prior.information) / np.outer(size, size)
        np.testing.assert_allclose(scaled, 0.0, atol=1e-8)
        of_factor = TorqueSums.of(factor).posterior(prior.mean, prior.information, 1e-6)
        alone = TorqueSums(gram, rows).posterior(mean, information, 1e-6)
        np.testing.assert_allclose(alone[1], of_factor[1], rtol=1e-6)


def test_excluded_readings_are_hardly_compared() -> None:
    signs = [Change("torque sign", (joint,)) for joint in range(20)]
    zeros = [Change("zero", (joint,), 0.5) for joint in range(3)]
    errors = {change: float(place) for place, change in enumerate([*signs, *zeros])}
    assert to_compare(errors, 30.0) == [*signs, *zeros]  # each joint has a sign and a zero
    assert to_compare(errors, 2.5) == [*signs[:3], zeros[0]]
    assert to_compare(errors, -1.0) == [signs[0], zeros[0]]
