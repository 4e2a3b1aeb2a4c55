"""Changes in series of a fleet: planted ones are found and dated, others are not invented."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from hil.compare.comparison import holm
from hil.fleet.series_changes import MIN_RECORDINGS, MIN_SIBLINGS, Series, common_course, courses

LONG = partial(pytest.param, marks=pytest.mark.long)
MONTHS = 24
SEASON = 0.06


def fleet(seed, *, robots=8, months=MONTHS, heat=True, fault=None, day=0.015, memory=0.0):
    """Relative friction of robots with a season and warm-ups; the first one has the fault."""
    random = np.random.default_rng(seed)
    family = []
    for robot in range(robots):
        time = np.sort(np.arange(months) + random.uniform(-0.1, 0.1, months))
        season = np.cos(2.0 * np.pi * time / 12.0)
        cold = random.uniform(0.0, 1.0, months)
        noise = day * random.standard_normal(months)
        for k in range(1, months):
            noise[k] = memory * noise[k - 1] + np.sqrt(1.0 - memory**2) * noise[k]
        value = 1.0 + SEASON * season + 0.08 * cold * heat + noise
        if fault is not None and robot == 0:
            value = value * (1.0 + fault(time))
        temperature = 35.0 - 8.0 * season - 12.0 * cold + 0.3 * random.standard_normal(months)
        columns = temperature[:, None] if heat else np.empty((months, 0))
        variance = np.full(months, 0.003**2)
        family.append(Series(time, value / value[:3].mean() - 1.0, variance, columns))
    return family


def wear(time):
    """7 % a month from the tenth on."""
    return 0.07 * np.maximum(time - 10.0, 0.0)


def lost_lubricant(time):
    return 0.2 * (time > 14.5)


def replaced_gear(time):
    return -0.25 * (time > 12.5)


class TestFound:
    """What was planted in the first robot, among seven without a fault."""

    @pytest.mark.parametrize(
        ("fault", "kind", "begin", "size"),
        [
            (wear, "slope", 10.0, 0.07),
            (lost_lubricant, "step", 14.5, 0.2),
            (replaced_gear, "step", 12.5, -0.25),
        ],
    )
    @pytest.mark.parametrize("heat", [True, LONG(False)])
    def test_with_kind_size_and_date(self, fault, kind, begin, size, heat):
        for seed in range(5):
            course, *others = courses(fleet(seed, fault=fault, heat=heat))
            (change, *further) = course.changes
            assert change.shape.kind == kind
            assert change.shape.begin == pytest.approx(begin, abs=1.0)
            assert change.earliest - 1.0 <= begin <= change.latest + 1.0
            assert change.size == pytest.approx(size, rel=0.25)
            assert not further or abs(further[0].size) < 0.1
            assert all(other.p_value > 1e-4 for other in others)

    @pytest.mark.parametrize(("fault", "tenth"), [(wear, 11.4), (lost_lubricant, 14.5)])
    def test_two_months_after_it_passes_ten_per_cent(self, fault, tenth):
        months = int(np.ceil(tenth)) + 3  # two recordings after it
        p_values = [courses(fleet(s, months=months, fault=fault))[0].p_value for s in range(5)]
        assert max(p_values) < 1e-4

    def test_wear_until_a_repair_is_two_changes(self):
        def repaired(time):
            return np.where(time < 16.5, wear(time), 0.0)

        course = courses(fleet(1, fault=repaired))[0]
        assert [change.shape.kind for change in course.changes][-1] == "step"
        assert course.changes[-1].shape.begin == pytest.approx(16.5, abs=0.6)
        assert abs(course.change) < 0.15
        assert course.largest == pytest.approx(0.07 * 6.0, abs=0.2)


class TestNotInvented:
    """Fleets without a fault."""

    @pytest.mark.parametrize(
        ("memory", "heat"),
        [
            pytest.param(0.5, True, marks=pytest.mark.long),
            pytest.param(0.5, False, marks=pytest.mark.long),
            pytest.param(0.0, True, marks=pytest.mark.long),
            (0.0, False),
        ],
    )
    def test_p_values_are_at_most_uniform(self, memory, heat):
        p_values = np.array(
            [
                course.p_value
                for seed in range(25)
                for course in courses(fleet(seed, heat=heat, memory=memory))
            ]
        )
        assert np.mean(p_values < 0.05) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / len(p_values))
        assert np.mean(p_values < 0.01) < 0.01 + 3.0 * np.sqrt(0.01 * 0.99 / len(p_values))

    @pytest.mark.parametrize("heat", [True, False])
    def test_a_season_is_none_though_it_is_one_without_adjustment(self, heat):
        """Half a year, in which all robots see the same half of the season."""
        found = courses(fleet(3, months=8, heat=heat, day=0.004))
        assert max(holm(np.array([course.unadjusted_p for course in found]))) < 0.01
        assert min(holm(np.array([course.p_value for course in found]))) > 0.01

    def test_one_robot_alone_with_its_temperature(self):
        p_values = [courses(fleet(seed, robots=1))[0].p_value for seed in range(30)]
        assert np.mean(np.array(p_values) < 0.05) <= 0.15

    @pytest.mark.long
    def test_a_robot_of_more_noise_than_its_siblings(self):
        alarms = 0
        for seed in range(20):
            family = fleet(seed, robots=8)
            noisy = fleet(seed + 100, robots=1, day=0.04)[0]
            alarms += courses([noisy, *family[1:]])[0].p_value < 0.01
        assert alarms <= 2

    @pytest.mark.parametrize("place", [LONG(0), LONG(3), LONG(-2), -1])
    def test_one_outlier_is_none(self, place):
        """Neither by a slope to the last recording, nor by two changes between three of them."""
        alarms = 0
        for seed in range(20):
            family = fleet(seed, months=9, heat=False)
            value = family[0].value.copy()
            value[place] -= 0.18
            found = courses([replace(family[0], value=value), *family[1:]])
            alarms += holm(np.array([each.p_value for each in found]))[0] < 0.01
        assert alarms <= 1

    def test_a_short_series_has_no_model(self):
        family = fleet(0, months=MIN_RECORDINGS - 1)
        assert courses(family) == [None] * len(family)


def test_effect_of_heat_is_that_of_the_siblings():
    """Percent per kelvin: 8 % over 12 K of warm-up, 6 % over 8 K of the season."""
    found = courses(fleet(5))
    effects = [course.effects[0] for course in found if course is not None]
    np.testing.assert_allclose(effects, -0.0070, atol=0.0012)


class TestAllTogether:
    """What moves all robots at once: a season is no change, another gearbox oil in all is one."""

    @staticmethod
    def moved(seed, *, months=MONTHS, begin=14.5, size=0.15, robots=8, heat=True):
        """A fleet whose friction changes in every robot at the same time."""
        return [
            Series(
                each.time,
                (1.0 + each.value) * (1.0 + size * (each.time > begin)) - 1.0,
                each.variance,
                each.covariates,
            )
            for each in fleet(seed, months=months, robots=robots, heat=heat)
        ]

    @pytest.mark.parametrize("heat", [True, LONG(False)])
    def test_is_dated_though_no_robot_differs_from_others(self, heat):
        for seed in range(5):
            family = self.moved(seed, heat=heat)
            common = common_course(family)
            assert common is not None
            (change,) = common.course.changes
            assert change.shape.begin == pytest.approx(14.5, abs=1.0)
            assert change.size == pytest.approx(0.15, abs=0.05)
            assert min(holm(np.array([each.p_value for each in courses(family)]))) > 0.01

    @pytest.mark.parametrize("heat", [True, LONG(False)])
    @pytest.mark.parametrize("months", [LONG(13), LONG(18), 24, LONG(36)])
    def test_is_not_invented(self, months, heat):
        p_values = [
            common_course(fleet(seed, months=months, heat=heat)).course.p_value
            for seed in range(60)
        ]
        assert np.mean(np.array(p_values) < 0.05) < 0.05 + 3.0 * np.sqrt(0.05 * 0.95 / 60)
        assert min(p_values) > 1e-4

    def test_is_unknown_before_a_year_and_of_few_robots(self):
        assert common_course(fleet(1, months=12)) is None
        assert common_course(fleet(1, robots=MIN_SIBLINGS)) is None
        assert common_course([]) is None

    def test_robots_that_came_later_do_not_count(self):
        """Their first months are others, to which their values are relative."""
        family = self.moved(2)
        late = [
            Series(each.time[-6:], 0.0 * each.value[-6:], each.variance[-6:], each.covariates[-6:])
            for each in fleet(9, robots=8)
        ]
        (change,) = common_course([*family, *late]).course.changes
        assert change.size == pytest.approx(0.15, abs=0.05)
