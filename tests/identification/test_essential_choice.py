"""The essential parameters on held-out motion, and what the choice is worth on other motion."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.errors import IdentificationError
from identification.factor.factor import joint_weights
from identification.factor.phases import PhaseFactor
from identification.model.friction import FrictionLaw
from identification.model.robot import RobotModel
from identification.selection.essential import CutRule, choose_essential, eliminate, relative_error
from identification.signals.samples import Samples
from identification.validation.prediction import over_all, prediction_error
from tests.identification.test_essential import (
    NOISE,
    URDF,
    a_motion,
    model,  # noqa: F401 - a fixture
    samples_of,
    truth,  # noqa: F401 - a fixture
)

Array = NDArray[np.float64]

# ruff: noqa: F811 - fixtures are named as arguments


def runs_of(model: RobotModel, truth: Array, seed: int, count: int) -> list[Samples]:
    seeds = range(seed, seed + count)
    return [samples_of(model, truth, a_motion(k), NOISE, k) for k in seeds]


def factors_of(model: RobotModel, runs: list[Samples]) -> list[PhaseFactor]:
    return [PhaseFactor.from_samples(model, run) for run in runs]


def test_the_relative_error_is_that_of_the_prediction(model: RobotModel, truth: Array) -> None:
    runs = runs_of(model, truth, 3, 2)
    values = 1.1 * truth
    both = sum(factors_of(model, runs), PhaseFactor.zero(model)).total
    expected = over_all(prediction_error(model, values, runs)).overall
    assert relative_error(both, values) == pytest.approx(expected, rel=1e-9)


@settings(max_examples=8)
@given(st.integers(0, 1000))
def test_a_blind_choice_never_sees_the_held_out_motion(seed: int) -> None:
    """Recomputed from rows: chosen on the end of what is fitted, fitted to all, then tried."""
    arm = RobotModel.from_urdf(URDF, friction=FrictionLaw(offset=True))
    values = np.random.default_rng(seed).normal(1.0, 1.0, arm.n_parameters)
    fitted, *unseen = runs_of(arm, values, seed, 3)
    training, *held_out = factors_of(arm, [fitted, *unseen])
    found = choose_essential(arm, training, held_out)
    assert found.blind is not None
    weights = joint_weights(training.total)
    edge = round(0.7 * len(training)) * 25  # rows in a block of 0.125 s
    first, last = (
        PhaseFactor.from_samples(arm, part_of(fitted, rows))
        for rows in (slice(0, edge), slice(edge, None))
    )
    names = eliminate(arm, first, last, weights=weights).estimate.names
    kept = [arm.parameter_names.index(name) for name in names]
    dense = arm.regressor(*fitted.motion[1:]).dense(arm.n_parameters)[:, :, kept]
    scale = np.sqrt(weights) * fitted.usable
    values = np.zeros(arm.n_parameters)
    values[kept] = np.linalg.lstsq(
        (dense * scale[..., None]).reshape(-1, len(kept)),
        (fitted.torque * scale).ravel(),
        rcond=None,
    )[0]
    expected = over_all(prediction_error(arm, values, unseen)).overall
    assert found.blind.left == len(kept)
    assert found.blind.essential == pytest.approx(expected, rel=1e-6)


def part_of(run: Samples, rows: slice) -> Samples:
    motion = run.motion.rows(rows)
    return replace(
        run,
        motion=motion,
        torque=run.torque[rows],
        usable=run.usable[rows],
        segments=(slice(0, len(motion.time)),),
    )


def test_too_short_a_motion_has_no_part_to_choose_on(model: RobotModel, truth: Array) -> None:
    training, unseen = factors_of(model, runs_of(model, truth, 1, 2))
    assert choose_essential(model, training, [unseen]).blind is not None
    assert choose_essential(model, training.blocks(slice(0, 20)), [unseen]).blind is None


def test_the_rule_of_thumb_is_the_path_that_no_held_out_error_stops(
    model: RobotModel, truth: Array
) -> None:
    training, *held_out = factors_of(model, runs_of(model, truth, 1, 3))
    found = choose_essential(model, training, held_out)
    assert found.by_spread.spread < CutRule().spread
    assert len(found.by_spread_names) == found.by_spread.left
    assert found.by_spread.left <= found.elimination.chosen.left
    assert found.elimination.chosen.held_out <= found.by_spread.held_out + 2 * CutRule().overall


def test_many_recordings_cost_no_more_than_few(model: RobotModel, truth: Array) -> None:
    """Blocks are merged; the error over all of them is the same sum."""
    training, *held_out = factors_of(model, runs_of(model, truth, 1, 9))
    found = choose_essential(model, training, held_out)
    total = sum(held_out, PhaseFactor.zero(model)).total
    assert found.elimination.chosen.held_out == pytest.approx(
        relative_error(total, found.elimination.values), rel=1e-9
    )


def test_without_held_out_motion_nothing_is_chosen(model: RobotModel, truth: Array) -> None:
    (training,) = factors_of(model, runs_of(model, truth, 1, 1))
    with pytest.raises(IdentificationError, match="no held-out motion"):
        choose_essential(model, training, [])
    with pytest.raises(IdentificationError, match="not one usable held-out sample"):
        choose_essential(model, training, [PhaseFactor.zero(model)])
