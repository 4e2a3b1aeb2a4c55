"""A motion goes through model and samples as one argument."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from identification.errors import ShapeError
from identification.model.motion import Motion
from tests.identification.two_link import MODEL, a_motion, as_samples, truth


@dataclass(frozen=True, eq=False)
class WarmMotion(Motion):
    """A motion with one more array."""

    temperature: np.ndarray | None = None  # (m, n)


@pytest.fixture
def warm():
    motion = a_motion(2.0)
    return WarmMotion(
        **motion.columns(), temperature=np.arange(2.0 * motion.n_samples).reshape(-1, 2)
    )


class TestMotion:
    @pytest.mark.parametrize(
        "which",
        [slice(3, 9), np.array([5, 2]), np.arange(400) % 7 == 0],
        ids=["slice", "index", "mask"],
    )
    def test_its_rows_are_those_of_every_known_array(self, which):
        motion = replace(a_motion(2.0), load=np.arange(800.0).reshape(-1, 2))
        part = motion.rows(which)
        assert [*part.columns()] == ["time", "position", "velocity", "acceleration", "load"]
        for name, column in part.columns().items():
            np.testing.assert_array_equal(column, motion.columns()[name][which])

    def test_joined_motions_have_what_all_know(self):
        motion = a_motion(2.0)
        first = replace(motion, direction=np.sign(motion.velocity), load=motion.position)
        second = replace(motion, direction=np.sign(motion.velocity))
        joined = Motion.joined([first, second])
        assert joined.n_samples == 800
        assert joined.load is None
        np.testing.assert_array_equal(joined.direction[400:], second.direction)

    def test_it_is_finite_if_every_known_number_is(self):
        motion = a_motion(2.0)
        assert motion.finite
        load = np.zeros_like(motion.position)
        load[7, 1] = np.nan
        assert not replace(motion, load=load).finite

    def test_states_are_no_time_series(self):
        assert np.isnan(Motion.at_rest(np.zeros((3, 2))).time).all()

    def test_arrays_of_the_right_shape_are_not_copied(self):
        motion = a_motion(2.0)
        assert motion.checked(2) is motion
        whole_numbers = replace(motion, position=np.ones(motion.position.shape, dtype=int))
        assert whole_numbers.checked(2).position.dtype == np.float64
        with pytest.raises(ShapeError, match="acceleration"):
            replace(motion, acceleration=motion.acceleration[1:]).checked(2)


class TestAnotherArray:
    """A field that is added to a motion breaks nothing."""

    def test_it_goes_along(self, warm):
        part = WarmMotion.joined([warm, warm]).rows(slice(390, 410)).without_load()
        expected = np.concatenate([warm.temperature[390:], warm.temperature[:10]])
        np.testing.assert_array_equal(part.temperature, expected)
        assert part.converted(np.negative).checked(2).kinematics().temperature is part.temperature

    def test_model_and_samples_take_the_motion(self, warm):
        bare = a_motion(2.0)
        torque = MODEL.torque(truth(), warm)
        np.testing.assert_array_equal(torque, MODEL.torque(truth(), bare))
        for ours, theirs in zip(
            MODEL.regressor(warm).blocks, MODEL.regressor(bare).blocks, strict=True
        ):
            np.testing.assert_array_equal(ours, theirs)
        samples = as_samples(MODEL, warm, torque).with_friction_direction(MODEL)
        part = samples.with_load(MODEL, truth()).between(10, 50)
        np.testing.assert_array_equal(part.motion.temperature, warm.temperature[10:50])
