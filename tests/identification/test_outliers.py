from __future__ import annotations

import numpy as np

from identification.validation.residual_checks import find_outliers


def test_planted_spikes_are_counted_and_taken_off() -> None:
    random = np.random.default_rng(5)
    torque, residual = 10.0 * random.standard_normal((2, 5000, 2))
    residual *= 0.01
    hit = random.permutation(5000)[:25]
    residual[hit, 1] += 20.0
    usable = np.ones((5000, 2), dtype=np.bool_)
    usable[hit[:5], 1] = False  # what does not count is no outlier
    found = find_outliers(
        [
            (torque[:2000], residual[:2000], usable[:2000]),
            (torque[2000:], residual[2000:], usable[2000:]),
        ]
    )
    np.testing.assert_allclose(found.share, [0.0, 20 / 4995])
    assert found.power[0] == 0.0 and found.power[1] > 0.9
    np.testing.assert_allclose(found.without.rms, [0.1, 0.1], rtol=0.05)
    assert found.without.rows.tolist() == [5000, 4975]


def test_noise_of_any_size_has_none() -> None:
    noise = np.random.default_rng(6).standard_normal((20000, 3)) * [1e-6, 1.0, 1e6]
    found = find_outliers([(noise, noise, np.ones(noise.shape, dtype=np.bool_))])
    np.testing.assert_array_equal(found.share, 0.0)
