"""Sums of recordings are all that an estimate and its intervals need."""

from dataclasses import replace

import numpy as np
import pytest

from identification.estimators.prior import BODY_STD_SHARE
from identification.factor.factor import Factor
from identification.reduction.intervals import widened
from identification.reduction.posterior import Posterior
from identification.reduction.reduction import Reduction, reduce
from identification.selection.averaging import AveragedBandwidth
from identification.selection.settings import Settings, Strength
from identification.signals.samples import Preprocessing
from tests.identification.two_link import MODEL, NOISE, four_sines, simulated, truth

STEP = 0.004


def recorded(start=0.0, seed=0, model=MODEL):
    motion = four_sines(np.arange(start, start + 16.0, STEP))
    return simulated(model, truth(), motion, NOISE, seed)


def reduced(*versions, shares=(1.0,), unmodelled=True):
    return reduce(
        MODEL,
        versions,
        shares,
        uncertain_delay=True,
        known={},
        unmodelled=unmodelled,
        elastic=True,
    )


def wider(total, delay_variance):
    """Return everything that widens the intervals of one motion, and the estimate before."""
    posterior = Posterior.of(MODEL, total.factor, BODY_STD_SHARE, {}, Strength())
    pooled = posterior.fit(total.factor).estimate
    return pooled, widened(
        pooled,
        total,
        posterior,
        posterior.precision,
        delay_variance=delay_variance,
        repetitions=None,
        torque_scale=np.zeros(2),
        recordings=(),
    )


def estimated(total):
    return wider(total, 1e-7)[1].estimate


@pytest.fixture(scope="module")
def halves():
    return recorded(), recorded(20.0, seed=1)


def test_sums_add_in_any_order(halves):
    first, second = (reduced(samples) for samples in halves)
    one, other = estimated(first + second), estimated(second + first)
    np.testing.assert_allclose(one.values, other.values, rtol=1e-8)
    np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-12)


def test_nothing_adds_nothing(halves):
    one = reduced(halves[0])
    total = Reduction.total(MODEL, [one])
    np.testing.assert_array_equal(total.factor.gram, one.factor.gram)
    assert total.rates is one.rates
    assert total.unmodelled is one.unmodelled
    assert Reduction.total(MODEL, []).factor.samples.tolist() == [0, 0]


def test_repetitions_share_what_the_first_show_of_the_model(halves):
    """Three repetitions, of which one shows it, have the intervals of three that all do."""
    samples = halves[0]
    every = [reduced(samples) for _ in range(3)]
    some = [reduced(samples, unmodelled=k == 0) for k in range(3)]
    assert sum(some[1:], some[0]).times == pytest.approx(3.0)
    all_shown, one_shown = (estimated(Reduction.total(MODEL, each)) for each in (every, some))
    np.testing.assert_allclose(one_shown.values, all_shown.values, rtol=1e-9)
    np.testing.assert_allclose(one_shown.std, all_shown.std, rtol=0.05)


def drifting(count, drift):
    """Reductions of repetitions whose friction falls; the first three show what the model lacks."""
    motion = four_sines(np.arange(0.0, 16.0, STEP))
    cold = np.where(MODEL.friction_columns, truth(), 0.0)
    each = []
    for k in range(count):
        values = truth() + drift * np.exp(-k / 5.0) * cold
        samples = simulated(MODEL, values, motion, NOISE, seed=k)
        each.append(reduced(samples, unmodelled=k < 3))
    return each


@pytest.mark.parametrize("drift", [0.0, 0.02, 0.1])
def test_drift_is_neither_another_law_nor_an_elastic_gear(drift):
    """The first repetitions alone do not balance at the parameters of all of them."""
    total = Reduction.total(MODEL, drifting(10, drift))
    pooled, found = wider(total, 0.0)
    assert found.form is not None
    assert np.all(found.form.probability < 0.5)
    assert np.max(found.estimate.std / pooled.std) < 3.0


def test_campaigns_of_other_motions_add_by_their_rows(halves):
    """Three repetitions of one and thirty of another, of which three show what the model lacks."""
    few = Reduction.total(MODEL, [reduced(halves[0]) for _ in range(3)])
    many = Reduction.total(MODEL, [reduced(halves[1], unmodelled=k < 3) for k in range(30)])
    total = few.for_all_rows() + many.for_all_rows()
    assert total.times == pytest.approx(1.0, rel=1e-3)
    shown = total.unmodelled.forms.restricted(np.arange(MODEL.n_parameters))
    np.testing.assert_allclose(shown.gram, total.factor.gram, rtol=1e-9)


def test_versions_are_averaged(halves):
    samples = halves[0]
    louder = replace(samples, torque=3.0 * samples.torque)
    factor = reduced(samples, louder, shares=(0.75, 0.25)).factor
    alone = Factor.by_time(MODEL, samples)
    expected = 0.75 * alone.squared_torque + 0.25 * 9.0 * alone.squared_torque
    np.testing.assert_allclose(factor.squared_torque, expected)
    assert factor.samples.tolist() == alone.samples.tolist()


def test_settings_state_their_versions_and_shares():
    alone = Settings(Preprocessing(rigid_bandwidth=40.0))
    assert (alone.versions, alone.shares) == ((alone,), (1.0,))
    hedged = replace(alone, hedge=AveragedBandwidth(14.0, 0.25))
    widths = [each.preprocessing.rigid_bandwidth for each in hedged.versions]
    assert (widths, hedged.shares) == ([40.0, 14.0], (0.8, 0.2))


def test_a_recording_without_a_usable_row_is_reduced(halves):
    still = replace(halves[0], usable=np.zeros_like(halves[0].usable))
    one = reduced(still)
    assert one.factor.samples.tolist() == [0, 0]
    assert one.unmodelled is None
    whole = reduced(halves[0])
    np.testing.assert_array_equal((one + whole).factor.samples, whole.factor.samples)
