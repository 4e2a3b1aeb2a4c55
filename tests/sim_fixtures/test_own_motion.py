"""Moves of the controller's own."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_fixtures import SettingError
from sim_fixtures.controller import RUN_UP, OwnMotion

PERIOD = 0.002
SPEED = np.array([2.0, 3.0])
angles = st.floats(-2.0, 2.0)


def play(motion: OwnMotion, limit: int = 20_000) -> tuple[np.ndarray, np.ndarray]:
    rows = []
    while not motion.finished:
        rows.append(tuple(part.copy() for part in motion.advance()))
        assert len(rows) < limit
    q, qd = zip(*rows, strict=True)
    return np.array(q), np.array(qd)


def motion(*postures: tuple[float, float], start: tuple[float, float] = (0.0, 0.0)) -> OwnMotion:
    made = OwnMotion(postures, speed=SPEED, period=PERIOD, dwell=0.02)
    made.begin(start)
    return made


def test_each_posture_is_reached_exactly_and_rested_in() -> None:
    postures = [(0.5, -0.3), (-0.2, 0.4)]
    q, qd = play(motion(*postures))
    np.testing.assert_array_equal(q[-1], postures[1])
    np.testing.assert_array_equal(qd[-1], 0.0)
    resting = np.all(q == postures[0], axis=1)
    assert resting.sum() == pytest.approx(0.02 / PERIOD, abs=1)
    np.testing.assert_array_equal(qd[resting], 0.0)


@given(st.tuples(angles, angles), st.tuples(angles, angles))
def test_speed_and_acceleration_keep_their_bounds(
    there: tuple[float, float], start: tuple[float, float]
) -> None:
    q, qd = play(motion(there, start=start))
    assert np.all(np.abs(qd) <= SPEED * (1.0 + 1e-9))
    steps = np.diff(np.vstack((start, q)), axis=0) / PERIOD
    assert np.all(np.abs(steps) <= SPEED * (1.0 + 1e-6))
    assert np.all(np.abs(np.diff(qd, axis=0)) / PERIOD <= SPEED / RUN_UP * (1.0 + 1e-6))


def test_the_stated_velocity_is_the_derivative_of_the_positions() -> None:
    q, qd = play(motion((1.0, -1.0)))
    np.testing.assert_allclose(qd[1:-1], (q[2:] - q[:-2]) / (2.0 * PERIOD), atol=1e-4)


def test_the_jerk_is_finite_as_the_cycle_shrinks() -> None:
    def greatest_jerk(period: float) -> float:
        made = OwnMotion([(1.0, 1.0)], speed=SPEED, period=period, dwell=0.02)
        made.begin((0.0, 0.0))
        _, qd = play(made)
        return float(np.abs(np.diff(qd, n=2, axis=0)).max() / period**2)

    assert greatest_jerk(0.001) == pytest.approx(greatest_jerk(0.004), rel=0.1)


def test_told_to_end_it_finishes_the_move_under_way_and_begins_no_other() -> None:
    made = motion((0.5, 0.5), (1.0, 1.0))
    while made.at_rest:
        made.advance()
    made.end()
    q, _ = play(made)
    np.testing.assert_array_equal(q[-1], (0.5, 0.5))


def test_repeated_it_goes_to_and_fro_on_the_ways_of_the_list() -> None:
    stops = [(0.5, -0.3), (-0.2, 0.4), (0.1, 0.1)]
    made = OwnMotion(stops, speed=SPEED, period=PERIOD, dwell=0.02, repeats=True)
    made.begin((0.0, 0.0))
    visited: list[tuple[float, ...]] = []
    while len(visited) < 8:
        moved = not made.at_rest
        made.advance()
        assert not made.finished
        if moved and made.at_rest:
            visited.append(tuple(made.position.tolist()))
    first, second, third = stops
    assert visited == [first, second, third, second, first, second, third, second]
    made.end()
    assert made.finished


def test_a_single_posture_repeated_is_rested_in() -> None:
    made = OwnMotion([(0.5, -0.3)], speed=SPEED, period=PERIOD, dwell=0.02, repeats=True)
    made.begin((0.0, 0.0))
    for _ in range(2000):
        made.advance()
    np.testing.assert_array_equal(made.position, (0.5, -0.3))
    np.testing.assert_array_equal(made.velocity, 0.0)


def test_a_posture_of_another_arm_is_refused() -> None:
    with pytest.raises(SettingError, match="2 joint angles"):
        OwnMotion([(0.0, 0.0, 0.0)], speed=SPEED, period=PERIOD)


@pytest.mark.parametrize("speed", [0.0, np.inf, np.nan])
def test_an_arm_without_velocity_limits_does_not_move_by_itself(speed: float) -> None:
    with pytest.raises(SettingError, match="velocity limits"):
        OwnMotion([(0.0, 0.0)], speed=[1.0, speed], period=PERIOD)
