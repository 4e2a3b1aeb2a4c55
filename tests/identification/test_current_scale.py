from __future__ import annotations

import numpy as np
import pytest

from hil.identify.prepared import current_warnings
from identification.estimators.current_scale import CurrentScale, scale_from_nominal
from tests.identification.two_link import MODEL, a_motion, coloured

GAINS = np.array([12.0, 3.0])  # N·m/A


def scale(signs: tuple[float, float]) -> CurrentScale:
    """Gains from currents of the nominal arm with rotors and friction, times signs."""
    motion = a_motion()
    values = np.concatenate([MODEL.base.grouping @ MODEL.nominal, [4.0, 2.0, 1.5, 0.8]])
    noise = 0.1 * coloured(np.random.default_rng(0), len(motion.time), 5e-3, 0.0)
    torque = MODEL.torque(values, *motion[1:]) + noise
    return scale_from_nominal(MODEL, [motion], [torque / (GAINS * np.array(signs))])


@pytest.mark.parametrize("signs", [(1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_a_current_of_the_wrong_sign_is_named(signs: tuple[float, float]) -> None:
    found = scale(signs)
    np.testing.assert_allclose(found.values, GAINS * signs, rtol=0.02)
    np.testing.assert_array_equal(found.turned, np.array(signs) < 0.0)
    negative = [text for text in current_warnings(MODEL.joint_names, found) if "negative" in text]
    assert len(negative) == any(found.turned)
    for name, turned in zip(MODEL.joint_names, found.turned, strict=True):
        assert any(name in text for text in negative) == turned


def test_a_gain_that_is_not_known_is_not_turned() -> None:
    unknown = CurrentScale(
        np.array([-1.0, 2.0]), np.array([np.inf, 0.1]), np.zeros(2, dtype=np.bool_)
    )
    assert not unknown.turned.any()
