"""Quantities of the robots of one type over time, whether of recordings or of a table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.fleet import covariates
from hil.fleet.quantities import FollowedQuantity
from hil.fleet.series_changes import MIN_RECORDINGS, Series, mean_of_known

REFERENCE_MONTHS: Final = 3.0
"""First months of a robot, against which it has changed."""
MONTH: Final = timedelta(days=365.25 / 12.0)
_MIN_REFERENCE_RECORDINGS: Final = 3  # recordings that these have at least
_DETERMINED_SIGMAS: Final = 4.0  # standard deviations that a value exceeds


@dataclass(frozen=True, eq=False)
class DatedRecording:
    """A recording of a series: its date, ISO 8601, and numbers that may explain a change."""

    when: str
    facts: Mapping[str, float]

    @property
    def moment(self) -> datetime:
        """The date, in UTC where it states no zone."""
        return moment_of(self.when)


def moment_of(when: str) -> datetime:
    """Return a date in ISO 8601, in UTC where it states no zone."""
    moment = datetime.fromisoformat(when)
    return moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)


@dataclass(frozen=True, eq=False)
class QuantityFamily:
    """One quantity of all robots: values and variances (m,) of their recordings, NaN if unknown."""

    followed: FollowedQuantity
    values: Mapping[str, tuple[Array, Array]]


@dataclass(frozen=True, eq=False)
class TypeSeries:
    """All series of the robots of one type.

    Attributes:
        digest: of the type; "" if unknown.
        joints: names in their order.
        recordings: of each robot, in order of time.
        families: one for each quantity of each joint.
    """

    digest: str
    joints: tuple[str, ...]
    recordings: Mapping[str, Sequence[DatedRecording]]
    families: Sequence[QuantityFamily]

    @property
    def known(self) -> set[str]:
        """Names of the numbers that any recording has."""
        every = [each for recordings in self.recordings.values() for each in recordings]
        return {name for recording in every for name in recording.facts}

    def covariates_of(self, joint: str, stated: Sequence[str]) -> list[str]:
        """Return the covariates that concern a joint, and the requested ones."""
        numbers = {
            robot: [each.facts for each in recordings]
            for robot, recordings in self.recordings.items()
        }
        return covariates.chosen(numbers, stated, joint, self.joints)


def first_of(recordings: Sequence[DatedRecording]) -> int:
    """Return how many recordings are from the first months."""
    start = recordings[0].moment
    within = sum(each.moment - start < REFERENCE_MONTHS * MONTH for each in recordings)
    return max(min(_MIN_REFERENCE_RECORDINGS, len(recordings)), within)


class RelativeSeries(NamedTuple):
    """A series as shares of its first months, which have the `first` recordings."""

    series: Series
    dates: tuple[str, ...]
    values: Array
    stds: Array
    reference: float
    first: int

    @classmethod
    def of(
        cls,
        recordings: Sequence[DatedRecording],
        values: Array,
        variances: Array,
        names: Sequence[str],
        origin: datetime,
    ) -> RelativeSeries | None:
        """Return a series, None if it is too short, or zero within its errors.

        Args:
            recordings: of a robot, in order of time.
            values: of the quantity (m,).
            variances: of the values (m,).
            names: of covariates.
            origin: of its time.
        """
        known = np.flatnonzero(np.isfinite(values) & np.isfinite(variances))
        if len(known) < MIN_RECORDINGS:
            return None
        recordings = [recordings[k] for k in known.tolist()]
        values = values[known]
        variances = variances[known]
        first = first_of(recordings)
        reference = float(np.mean(values[:first]))
        error = float(np.sqrt(np.mean(variances[:first]) / first))
        if not abs(reference) > _DETERMINED_SIGMAS * error:
            return None
        times = np.array([(each.moment - origin) / MONTH for each in recordings])
        columns = np.array(
            [[each.facts.get(name, np.nan) for name in names] for each in recordings]
        ).reshape(len(recordings), len(names))
        series = Series(times, values / reference - 1.0, variances / reference**2, columns)
        dates = tuple(each.when for each in recordings)
        return cls(series, dates, values, np.sqrt(variances), reference, first)

    def of_an_error(self, series: Series) -> Series:
        """Return a series of an error of the first months' model.

        Its covariates are distances from those months: it grows whether a day is warmer or colder.
        """
        columns = series.covariates
        first = mean_of_known(columns[: self.first])
        return replace(series, covariates=np.abs(columns - first))
