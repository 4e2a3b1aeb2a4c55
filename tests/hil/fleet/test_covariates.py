"""What may explain a change of a joint: which numbers of recordings, and in which form."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hil.fleet.covariates import chosen, may_explain, names_of_joint, warmed
from hil.fleet.series import RelativeSeries
from hil.fleet.series_changes import Series, courses, scattered

JOINTS = ("shoulder", "elbow", "wrist")


@pytest.mark.parametrize(
    "name", ["joint_temp1", "T [°C]", "minutes_since_start", "uptime", "Warm-up [min]"]
)
def test_temperatures_and_times_since_start_are_found_by_name(name):
    assert may_explain(name)


@pytest.mark.parametrize("name", ["temporary", "time", "time_from_start", "template", "payload"])
def test_others_are_not(name):
    assert not may_explain(name)


@pytest.mark.parametrize(
    ("names", "joint", "own", "common"),
    [
        (["temp1", "temp2", "temp3", "ambient"], "elbow", ["temp2"], ["ambient"]),
        (["T_0", "T_1", "T_2"], "wrist", ["T_2"], []),
        (["m/wrist", "m/elbow", "m/shoulder", "ambient"], "elbow", ["m/elbow"], ["ambient"]),
        (["temp1", "temp2"], "shoulder", [], ["temp1", "temp2"]),
        ([], "shoulder", [], []),
    ],
)
def test_of_a_joint_are_its_own_and_those_of_none(names, joint, own, common):
    assert names_of_joint(names, joint, JOINTS) == (own, common)


class TestChosen:
    @staticmethod
    def of(*facts, stated=()):
        """The covariates of the elbow of one robot with these recordings."""
        return chosen({"robot": facts}, stated, "elbow", JOINTS)

    def test_are_those_that_most_recordings_have(self):
        """One log without its temperature does not cost the others theirs."""
        known = [{"temperature": 20.0 + k, "rare": float(k)} for k in range(6)]
        without = [{"temperature": 20.0 + k} for k in range(6)]
        assert self.of(*known, *without, {}) == ["temperature"]

    def test_are_those_stated_that_any_has(self):
        recordings = [{"temperature": 20.0 + k % 2} for k in range(6)]
        stated = [{"payload": float(k)} for k in range(2)]
        assert self.of(*recordings, *stated, stated=["payload"]) == ["payload", "temperature"]

    def test_vary_and_not_as_others_do(self):
        """A sensor that is stuck, and a temperature in two units, explain nothing more."""
        celsius = [20.0, 23.0, 21.0, 28.0]
        recordings = [{"stuck": 21.5, "temp_c": t, "temp_f": 1.8 * t + 32.0} for t in celsius]
        assert self.of(*recordings) == ["temp_c"]

    def test_that_differ_between_robots_alone_explain_no_change(self):
        recordings = {f"r{k}": [{"temperature": 20.0 + k}] * 5 for k in range(4)}
        assert chosen(recordings, (), "elbow", JOINTS) == []


def cold_and_warm(constant, *, size=0.08, robots=8, months=12, seed=0):
    """Robots whose friction falls by a warm-up, and the minutes since each was started."""
    random = np.random.default_rng(seed)
    family = []
    for _ in range(robots):
        minutes = random.uniform(0.0, 240.0, months)
        value = 1.0 + size * np.exp(-minutes / constant) + 0.004 * random.standard_normal(months)
        variance = np.full(months, 0.002**2)
        time = np.arange(months, dtype=np.float64)
        family.append(Series(time, value / value.mean() - 1.0, variance, minutes[:, None]))
    return family


class TestTimeSinceStart:
    @pytest.mark.parametrize("constant", [15.0, 60.0])
    def test_acts_as_a_warm_up_with_a_constant_that_the_robots_show(self, constant):
        family = cold_and_warm(constant)
        found = courses(warmed(family, ["minutes_since_start"]))
        effects = [course.effects[0] for course in found]
        np.testing.assert_allclose(effects, 0.08, rtol=0.2)
        left = np.std([course.adjusted for course in found])
        assert left < 0.006  # of noise 0.004
        assert np.std([course.adjusted for course in courses(family)]) > 1.3 * left

    def test_of_another_name_is_a_number_as_others(self):
        family = cold_and_warm(60.0)
        assert warmed(family, ["payload"]) == family


def test_the_error_of_the_first_model_grows_to_both_sides():
    """Of a day warmer or colder than the first months alike."""
    columns = np.array([[20.0], [22.0], [10.0], [30.0]])
    series = Series(np.arange(4.0), np.zeros(4), np.zeros(4), columns)
    of_two = RelativeSeries(series, (), np.zeros(4), np.zeros(4), 1.0, 2)
    np.testing.assert_allclose(of_two.of_an_error(series).covariates[:, 0], [1.0, 1.0, 11.0, 9.0])


def test_an_error_that_grows_in_all_robots_is_no_change():
    """It grows in all robots, as in a season, by about four times, and is then less certain."""
    p_values = []
    for seed in range(20):
        random = np.random.default_rng(seed)
        growth = 4.0 * np.exp(0.4 * random.standard_normal((5, 1)))
        size = 1.0 + np.maximum(0.0, np.arange(10.0) - 2.0) / 7.0 * (growth - 1.0)
        values = size * np.exp(0.2 * random.standard_normal((5, 10)))
        family = [
            Series(np.arange(10.0), each / each[:3].mean() - 1.0, np.zeros(10), np.empty((10, 0)))
            for each in values
        ]
        p_values += [course.p_value for course in courses(scattered(family))]
    assert min(p_values) > 0.01 / 150  # of a fleet of five robots with six joints


def test_an_unknown_temperature_is_worth_less_and_costs_no_other():
    """A robot with two recordings of unknown temperature, in a family whose effect is known."""
    family = []
    for seed in range(6):
        random = np.random.default_rng(seed)
        heat = random.uniform(-10.0, 10.0, 16)
        value = 0.01 * heat + 0.003 * random.standard_normal(16)
        family.append(Series(np.arange(16.0), value, np.full(16, 1e-6), heat[:, None]))
    lacking = family[0].covariates.copy()
    lacking[[3, 9]] = np.nan
    (found, *others) = courses([replace(family[0], covariates=lacking), *family[1:]])
    assert found.p_value > 0.01
    assert found.std[3] > 3.0 * found.std[4]
    assert found.effects[0] == pytest.approx(0.01, abs=0.001)
    assert [course.effects[0] for course in others] == pytest.approx([0.01] * 5, abs=0.001)
