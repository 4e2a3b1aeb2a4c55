"""What may explain a change of a joint: temperatures, time since start, stated columns."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from hil.base.arrays import Array
from hil.fleet.series_changes import Series, mean_of_known, unexplained

_HEAT: Final = re.compile(r"temp(?!late|orary|lat|t)|celsius|°c", re.IGNORECASE)
_SINCE_START: Final = re.compile(
    r"(since|after)[ _-]*(the[ _-]*)?(start|power|switch|boot|cold)"
    r"|up[ _-]?time|warm(ed|ing)?[ _-]?up|(minutes|hours)[ _-]?(on|running)(?![a-z])",
    re.IGNORECASE,
)
_MAX_COMMON_COVARIATES: Final = 2  # covariates that concern all joints
# of a warm-up, of the longest time since a start
_TIME_CONSTANT_SHARES: Final = 2.0 ** np.arange(-5.0, 3.0)
_MIN_INDEPENDENT_SHARE: Final = 1e-6  # of a covariate, that others leave of it


def is_heat(name: str) -> bool:
    """Return whether a name or a unit means a temperature."""
    return _HEAT.search(name) is not None


def is_since_start(name: str) -> bool:
    """Return whether a name means the time since a robot was started."""
    return _SINCE_START.search(name) is not None


def may_explain(name: str) -> bool:
    """Return whether a column is a covariate without being requested."""
    return is_heat(name) or is_since_start(name)


def chosen(
    recordings: Mapping[str, Sequence[Mapping[str, float]]],
    stated: Sequence[str],
    joint: str,
    joints: Sequence[str],
) -> list[str]:
    """Return the covariates of a joint: its own, and at most two of the whole robot, stated first.

    A covariate is used if it is stated or most recordings have it, and if it varies within a robot
    independently of the others.

    Args:
        recordings: of each robot, their numbers by name.
        stated: requested names.
        joint: of which covariates are returned.
        joints: names of all, in their order.
    """
    every = [facts for each in recordings.values() for facts in each]
    counts: dict[str, int] = {}
    for facts in every:
        for name in facts:
            counts[name] = counts.get(name, 0) + 1
    usable = [name for name, count in counts.items() if 2 * count > len(every) or name in stated]
    usable.sort(key=lambda name: name not in stated)
    own, common = names_of_joint(usable, joint, joints)
    names = [*own, *common]
    independent = _independent(
        [
            np.array([[facts.get(name, np.nan) for name in names] for facts in each])
            for each in recordings.values()
            if each and names
        ]
    )
    varying = [names[k] for k in independent]
    of_joint = [name for name in varying if name in own]
    return [*of_joint, *[name for name in varying if name not in own][:_MAX_COMMON_COVARIATES]]


def _independent(columns: Sequence[Array]) -> list[int]:
    """Return which columns (m, c) vary within robots, and not as an earlier column does."""
    if not columns:
        return []
    every = np.nan_to_num(np.concatenate([each - mean_of_known(each) for each in columns]))
    sizes = np.linalg.norm(np.nan_to_num(np.concatenate(columns)), axis=0)
    independent: list[int] = []
    for k, column in enumerate(every.T):
        others = every[:, independent]
        rest = column - others @ np.linalg.lstsq(others, column, rcond=None)[0]
        if np.linalg.norm(rest) > _MIN_INDEPENDENT_SHARE * sizes[k]:
            independent.append(k)
    return independent


def names_of_joint(
    names: Sequence[str], joint: str, joints: Sequence[str]
) -> tuple[list[str], list[str]]:
    """Return a joint's own covariate, and the covariates of the whole robot.

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
    index = joints.index(joint)
    own = []
    of_joints: set[str] = set()
    for found in by_stem.values():
        for each in ends:
            if {*found} == {*each}:
                own.append(found[each[index]])
                of_joints.update(found.values())
                break
    return own[:1], [name for name in names if name not in of_joints]


def warmed(family: Sequence[Series], names: Sequence[str]) -> list[Series]:
    """Return series with the share of a warm-up to come in place of the time since a start.

    It is exp(-t / c), with the constant c of all robots with which the covariates leave least.
    """
    found = list(family)
    for k, name in enumerate(names):
        times = np.concatenate([np.zeros(1), *(each.covariates[:, k] for each in found)])
        longest = float(np.nanmax(times))
        if is_since_start(name) and longest > 0.0:
            tried = [
                [_warmed(each, k, longest * c) for each in found] for c in _TIME_CONSTANT_SHARES
            ]
            found = min(tried, key=unexplained)
    return found


def _warmed(series: Series, k: int, constant: float) -> Series:
    columns = series.covariates.copy()
    columns[:, k] = np.exp(-np.maximum(columns[:, k], 0.0) / constant)
    return replace(series, covariates=columns)
