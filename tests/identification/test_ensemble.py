"""Arms drawn from a posterior: they can be built, and their torques vary as the intervals say."""

from dataclasses import replace

import numpy as np
import pytest

from identification.estimators.consistent import is_consistent
from identification.estimators.ensemble import UndeterminedError, draw_ensemble
from identification.estimators.prior import body_prior, fit_posterior
from identification.estimators.torque_scale import absolute
from identification.factor.factor import Factor
from identification.model.pseudo_inertia import margin
from tests.identification.two_link import MODEL, NOISE, a_motion, simulated, truth


@pytest.fixture(scope="module")
def posterior():
    factor = Factor.by_time(MODEL, simulated(MODEL, truth(), a_motion(4.0), NOISE, seed=3))
    prior = body_prior(MODEL, factor)
    return prior, fit_posterior(MODEL, factor, prior.gaussian).estimate, factor


@pytest.fixture(scope="module")
def ensemble(posterior):
    return draw_ensemble(MODEL, *posterior, count=400, seed=5)


@pytest.mark.long
def test_every_arm_can_be_built(ensemble) -> None:
    assert len(ensemble) == 400
    for standard, values in zip(ensemble.standard, ensemble.values, strict=True):
        assert margin(standard[MODEL.layout.links]).min() > 0.0
        assert is_consistent(MODEL, np.concatenate([standard, values[MODEL.base.rank :]]))
        assert values[: MODEL.base.rank] == pytest.approx(MODEL.base.grouping @ standard)


def test_torques_vary_as_the_stated_intervals(posterior, ensemble) -> None:
    """Within 5 %, over all joints, on the motion of the estimate."""
    _, estimate, factor = posterior
    grams = factor.gram[:, :-1, :-1]
    change = ensemble.values - ensemble.values.mean(axis=0)
    drawn = np.einsum("ka,jab,kb->j", change, grams, change) / (len(change) - 1)
    stated = np.einsum("jab,ab->j", grams, estimate.covariance)
    assert np.sqrt(np.mean(drawn / stated)) == pytest.approx(1.0, abs=0.05)
    assert ensemble.spread == pytest.approx(np.sqrt(drawn / stated))


@pytest.mark.long
def test_the_scale_of_the_torque_moves_no_arm(posterior, ensemble) -> None:
    """They are for use with the torques of the same arm."""
    prior, estimate, factor = posterior
    uncertain = replace(estimate, scale_change=np.outer(estimate.values, [0.03, 0.03]))
    assert np.all(absolute(uncertain).std >= estimate.std)
    assert np.any(absolute(uncertain).std > 2.0 * estimate.std)
    again = draw_ensemble(MODEL, prior, uncertain, factor, count=400, seed=5)
    np.testing.assert_array_equal(again.values, ensemble.values)


def test_a_seed_gives_one_ensemble(posterior) -> None:
    first, again, other = (
        draw_ensemble(MODEL, *posterior, count=5, seed=seed).values for seed in (1, 1, 2)
    )
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


def test_nothing_is_drawn_from_an_unknown_uncertainty(posterior) -> None:
    prior, estimate, factor = posterior
    covariance = estimate.covariance.copy()
    covariance[0, 0] = np.inf
    with pytest.raises(UndeterminedError, match="is not known"):
        draw_ensemble(MODEL, prior, replace(estimate, covariance=covariance), factor, 3, 1)
