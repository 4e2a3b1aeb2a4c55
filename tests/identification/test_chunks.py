"""One recording or many pieces of it: every estimator gives the same to nine digits."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from identification.estimators.consistent import consistent_estimate
from identification.estimators.instrumental import estimate_instrumental
from identification.estimators.least_squares import fit_least_squares
from identification.estimators.losses import Huber, Tukey
from identification.estimators.prior import fit_with_prior, nominal_prior
from identification.estimators.robust import robust_estimate
from identification.factor.factor import Estimate
from identification.factor.phases import PhaseFactor, instrument_factor, joined, total_phase
from identification.model.motion import Motion
from identification.selection.essential import eliminate
from identification.signals.samples import Samples
from identification.validation.endogeneity import endogeneity_test
from tests.identification.two_link import MODEL, a_motion, coloured, recording

Array = NDArray[np.float64]
Pieces = Sequence[tuple[Samples, Motion]]
"""Pieces of a recording, each with its piece of the plan."""


@cache
def whole() -> tuple[Samples, Motion]:
    plan = a_motion(5.0)
    rng = np.random.default_rng(7)
    motion = plan._replace(acceleration=plan.acceleration + rng.normal(0.0, 0.3, (1000, 2)))
    samples = recording(coloured(rng, len(plan.time), 5e-3, 0.02), motion)
    samples.torque[100:110] += 40.0  # something for a robust loss to doubt
    return samples, plan


def cut(places: Sequence[int]) -> Pieces:
    """The recording in pieces, as archives of one run have it: with a common origin."""
    samples, plan = whole()
    edges = [0, *sorted(places), len(plan.time)]
    parts = [slice(a, b) for a, b in pairwise(edges) if b > a]
    return [
        (
            replace(
                samples,
                motion=samples.motion.rows(part),
                torque=samples.torque[part],
                usable=samples.usable[part],
                segments=(slice(0, part.stop - part.start),),
            ),
            plan.rows(part),
        )
        for part in parts
    ]


def recordings(pieces: Pieces) -> list[Samples]:
    return [samples for samples, _ in pieces]


def instruments(pieces: Pieces) -> PhaseFactor:
    factors = [instrument_factor(MODEL, *piece) for piece in pieces]
    total = factors[0]
    for factor in factors[1:]:
        total = total + factor
    return total


def consistent(pieces: Pieces) -> Estimate:
    factor = total_phase(MODEL, recordings(pieces)).total
    free = fit_least_squares(MODEL, recordings(pieces))
    return consistent_estimate(MODEL, factor, free).estimate


ESTIMATORS: dict[str, Callable[[Pieces], Estimate]] = {
    "ordinary": lambda pieces: fit_least_squares(MODEL, recordings(pieces), "ordinary"),
    "weighted": lambda pieces: fit_least_squares(MODEL, recordings(pieces)),
    "prior": lambda pieces: (
        fit_with_prior(MODEL, recordings(pieces), nominal_prior(MODEL)).estimate
    ),
    "huber": lambda pieces: (
        robust_estimate(MODEL, recordings(pieces), Huber(), tolerance=1e-11).estimate
    ),
    "tukey": lambda pieces: (
        robust_estimate(MODEL, recordings(pieces), Tukey(), tolerance=1e-11).estimate
    ),
    "instrumental": lambda pieces: estimate_instrumental(MODEL, instruments(pieces)).estimate,
    "consistent": consistent,
}


def deviations(one: Estimate, other: Estimate) -> Array:
    """Difference of the values in standard deviations."""
    return np.asarray(np.abs(one.values - other.values) / one.std)


@cache
def from_one(name: str) -> Estimate:
    return ESTIMATORS[name](cut([]))


@pytest.mark.parametrize("name", ESTIMATORS)
@given(places=st.lists(st.integers(1, 999), max_size=12))
@settings(max_examples=6, deadline=None)
def test_pieces_of_any_length_give_the_same_values_and_covariance(
    name: str, places: list[int]
) -> None:
    one, many = from_one(name), ESTIMATORS[name](cut(places))
    assert deviations(one, many).max() < 1e-9
    np.testing.assert_allclose(many.std, one.std, rtol=1e-9)
    assert many.method.rpartition(", ")[2] == one.method.rpartition(", ")[2]  # the blocks


@pytest.mark.parametrize("name", sorted(set(ESTIMATORS) - {"huber", "tukey", "consistent"}))
def test_a_thousand_pieces_of_one_sample_each_do_too(name: str) -> None:
    many = ESTIMATORS[name](cut(range(1, 1000)))
    assert deviations(from_one(name), many).max() < 1e-9
    np.testing.assert_allclose(many.std, from_one(name).std, rtol=1e-9)


def test_the_test_for_bias_does_not_depend_on_the_pieces_either() -> None:
    one, many = (
        endogeneity_test(MODEL, factor, estimate_instrumental(MODEL, factor))
        for factor in map(instruments, (cut([]), cut([17, 400, 401, 800])))
    )
    assert many.statistic == pytest.approx(one.statistic, rel=1e-7)
    assert many.words == one.words


# The factor itself


def test_blocks_can_be_picked_put_in_a_row_merged_and_restricted() -> None:
    phase = total_phase(MODEL, recordings(cut([])))
    half = len(phase) // 2
    again = joined([phase.blocks(slice(0, half)), phase.blocks(slice(half, None))])
    weights = np.array([0.5, 2.0])
    np.testing.assert_array_equal(again.weighted(weights), phase.weighted(weights))
    dense = np.tensordot(weights, phase.total.gram, axes=1)
    for length in (1, 3, len(phase)):
        merged = phase.merged(length)
        assert len(merged) == -(-len(phase) // length)
        np.testing.assert_allclose(merged.weighted(weights).sum(axis=0), dense, rtol=1e-12)
    kept = np.array([5, 0, 3])
    place = np.append(kept, MODEL.n_parameters)
    some = phase.restricted(kept)
    assert some.parameter_names == tuple(MODEL.parameter_names[k] for k in kept)
    np.testing.assert_allclose(
        some.weighted(weights), phase.weighted(weights)[:, place[:, None], place], rtol=1e-12
    )


def test_blocks_without_rows_are_left_out_and_change_nothing() -> None:
    samples, _ = whole()
    late = replace(samples, origin=samples.origin - 3.0)
    phase, same = (PhaseFactor.from_samples(MODEL, one) for one in (late, samples))
    assert len(phase) == len(same) + 24
    assert len(phase.occupied()) == len(same)
    training = eliminate(MODEL, phase, same).estimate
    assert training.names == eliminate(MODEL, same, same).estimate.names
