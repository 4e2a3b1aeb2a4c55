"""Quantities of the robots of one type over time, whether of recordings or of a table."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Final, NamedTuple

import numpy as np

from hil.base.arrays import Array
from hil.fleet.quantities import FollowedQuantity
from hil.fleet.series_changes import FEWEST, Series

REFERENCE: Final = 3.0
"""First months of a robot, against which it has changed."""
MONTH: Final = timedelta(days=365.25 / 12.0)
_FIRST: Final = 3  # recordings that these have at least
_DETERMINED: Final = 4.0  # standard deviations that a value exceeds
_MOST_COMMON: Final = 2  # covariates that concern all joints


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

    def covariates(self, more: Sequence[str]) -> list[str]:
        """Return the names of numbers that every recording has, and of those that were asked for.

        Of `more` only those that any has.
        """
        counts: dict[str, int] = {}
        every = [each for recordings in self.recordings.values() for each in recordings]
        for recording in every:
            for name in recording.facts:
                counts[name] = counts.get(name, 0) + 1
        return [name for name, count in counts.items() if count == len(every) or name in more]

    def covariates_of(self, joint: str, more: Sequence[str]) -> list[str]:
        """Return the covariates that concern a joint."""
        return names_of_joint(self.covariates(more), joint, self.joints)


def first_of(recordings: Sequence[DatedRecording]) -> int:
    """Return how many recordings are of the first months."""
    start = recordings[0].moment
    within = sum(each.moment - start < REFERENCE * MONTH for each in recordings)
    return max(min(_FIRST, len(recordings)), within)


class RelativeSeries(NamedTuple):
    """A series as shares of its first months."""

    series: Series
    dates: tuple[str, ...]
    values: Array
    stds: Array
    reference: float

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
        if len(known) < FEWEST:
            return None
        recordings = [recordings[k] for k in known.tolist()]
        values = values[known]
        variances = variances[known]
        first = first_of(recordings)
        reference = float(np.mean(values[:first]))
        error = float(np.sqrt(np.mean(variances[:first]) / first))
        if not abs(reference) > _DETERMINED * error:
            return None
        times = np.array([(each.moment - origin) / MONTH for each in recordings])
        columns = np.array(
            [[each.facts.get(name, np.nan) for name in names] for each in recordings]
        ).reshape(len(recordings), len(names))
        series = Series(times, values / reference - 1.0, variances / reference**2, _filled(columns))
        dates = tuple(each.when for each in recordings)
        return cls(series, dates, values, np.sqrt(variances), reference)


def _filled(columns: Array) -> Array:
    """Return covariates with the mean of the others where one is missing, 0 where all are."""
    counts = np.isfinite(columns).sum(axis=0)
    means = np.nansum(columns, axis=0) / np.maximum(counts, 1)
    return np.where(np.isfinite(columns), columns, means)


def names_of_joint(names: Sequence[str], joint: str, joints: Sequence[str]) -> list[str]:
    """Return the covariates that concern a joint: its own, and two at most of no joint.

    Covariates of joints end with the names of all of these, or with their numbers from 0 or 1.
    """
    by_stem: dict[str, dict[str, str]] = {}
    for name in names:
        if (match := re.fullmatch(r"(.*?)_?(\d+)", name)) is not None:
            by_stem.setdefault(match[1], {})[match[2]] = name
        stem, _, end = name.rpartition("/")
        if end in joints:
            by_stem.setdefault(stem, {})[end] = name
    count = len(joints)
    ends = ([*map(str, range(count))], [*map(str, range(1, count + 1))], [*joints])
    place = joints.index(joint)
    own = []
    of_joints: set[str] = set()
    for found in by_stem.values():
        for each in ends:
            if {*found} == {*each}:
                own.append(found[each[place]])
                of_joints.update(found.values())
                break
    return [*own[:1], *[name for name in names if name not in of_joints][:_MOST_COMMON]]
