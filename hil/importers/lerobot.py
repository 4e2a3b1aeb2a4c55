"""Data sets of LeRobot, versions 2.0 to 3.0: episodes of states and actions as recordings.

A data set is a folder with ``meta/info.json`` and Parquet tables in ``data``, one for each episode
(2.x) or several episodes in one (3.0). Joints are in degrees, or -100 to 100 between the ends of
the range that was calibrated; a gripper is 0 (closed) to 100. Simulators write radians.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from hil.base.arrays import Array
from hil.base.errors import SourceError
from hil.base.safe_input import parse_json, read_text
from hil.base.toml_text import to_text
from hil.importers.array_files import ArrayFile
from hil.importers.conclusions import EpisodeUnits, UnitsFrom
from hil.importers.imported_robot import Robot
from hil.importers.log_files import LogFiles
from identification.model.joint_ranges import urdf_limits

EpisodeUnit = Literal["deg", "rad", "range"]
"""Of the joints of a data set: degrees, radians, or -100 to 100 of the calibrated range."""

INFO: Final = Path("meta") / "info.json"
_FORMER_INFO: Final = Path("meta_data") / "info.json"  # of versions 1
_VERSIONS: Final = (2, 3)
_NAMED: Final = 5  # missing episodes in a message
_CALIBRATED: Final = (0.1, 2.0)  # least and most of the URDF's range that may be calibrated
STATE: Final = "observation.state"
ACTION: Final = "action"
_TIME: Final = "timestamp"
_EPISODE: Final = "episode_index"
_GRIPPER: Final = ("gripper", "jaw")
_FULL_RANGE: Final = 100.0
_RANGE_ROUNDING: Final = 0.5  # beyond 100 that is still a rounded value of the range
_STEPS_PER_TURN: Final = 4095  # of a turn, as LeRobot converts steps of a servo to degrees
_STEP_TOLERANCE: Final = 5e-3  # relative, between encoders of 4095 and 4096 steps
_FEWEST_STEPS: Final = 16  # different positions of a joint whose step is known
_FEWEST_ENCODERS: Final = 2  # joints whose steps say the unit
_LEAST_STEP: Final = 5e-4  # in any unit: less is rounding
_LARGEST_REMAINDER: Final = 0.1  # of a step, of differences that are whole steps
# outside the URDF's limits that no calibration explains
_MAX_LIMIT_EXCESS: Final = math.radians(10.0)
_SUFFIXES: Final = re.compile(r"\.(?:pos|position|angle)\Z|_(?:pos|position|joint)\Z")
_PREFIXES: Final = re.compile(r"\A(?:main|follower|robot)_")


@dataclass(frozen=True, eq=False)
class Episode:
    """An episode of a data set.

    Attributes:
        source: the table that it is in.
        path: by which it is named, and by which it is read from `files`.
        files: its arrays, in memory.
        number: of the episode.
    """

    source: Path
    path: Path
    files: LogFiles
    number: int


@dataclass(frozen=True, eq=False)
class DataSet:
    """A data set of LeRobot.

    Attributes:
        folder: of the data set.
        joints: names of the numbers of a state.
        commanded: indices of the numbers of an action that command these (n,).
        episodes: in their order.
        largest: largest size of each joint in all episodes (n,), in its own units.
        steps: of the positions of each joint (n,), in its own units; nan where there are none.
    """

    folder: Path
    joints: tuple[str, ...]
    commanded: tuple[int, ...]
    episodes: tuple[Episode, ...]
    largest: Array
    steps: Array

    @property
    def longest(self) -> Episode:
        """The longest episode, which a look is at."""
        return max(self.episodes, key=lambda each: each.files.arrays(each.path).shape(STATE)[0])

    @classmethod
    def read(cls, folder: Path) -> DataSet:
        """Read a data set.

        Raises:
            SourceError: it has no states, actions or episodes, or cannot be read.
        """
        info = _info(folder)
        joints = _names(folder, info, STATE)
        actions = _names(folder, info, ACTION)
        missing = [name for name in joints if name not in actions]
        if missing and len(joints) != len(actions):
            problem = f"has no action of {', '.join(missing)}"
            remedy = "give a data set of one arm, whose actions are positions of its joints"
            raise SourceError(folder, problem, field=ACTION, remedy=remedy)
        by_name = [joints.index(n) if missing else actions.index(n) for n in joints]
        tables = sorted((folder / "data").rglob("*.parquet"))
        episodes = [episode for table in tables for episode in _episodes(folder, table)]
        _require_all(folder, info, {each.number for each in episodes})
        states = [each.files.arrays(each.path).matrix(STATE, STATE) for each in episodes]
        largest = np.max([np.abs(state).max(axis=0) for state in states], axis=0)
        episodes.sort(key=lambda each: each.number)
        steps = np.array([_step(column) for column in np.concatenate(states).T])
        return cls(folder, joints, tuple(by_name), tuple(episodes), largest, steps)

    def map_for(
        self, robot: Robot, calibration: Path | None, unit: EpisodeUnit | None
    ) -> tuple[str, EpisodeUnits]:
        """Return the column map of each episode for a robot, TOML, and the units that it has.

        Args:
            robot: whose joints have the names of the data set, or its order.
            calibration: LeRobot's calibration of the arm, JSON; None without one.
            unit: of the joints, None to conclude it.

        Raises:
            SourceError: joints or units are not clear, or the calibration lacks a joint.
        """
        joints = self._joints_of(robot)
        limits = urdf_limits(robot.urdf, joints)
        ranges = None if calibration is None else _calibrated(calibration, self.joints)
        units = self._units(limits.lower, limits.upper, ranges, unit)
        scale = np.full(len(joints), math.radians(1.0))
        offset = np.zeros(len(joints))
        for j, name in enumerate(self.joints):
            span = limits.upper[j] - limits.lower[j]
            if calibration is not None and ranges is not None:
                _require_like(calibration, name, ranges[j], span)
                span = ranges[j]
            if units.unit == "rad" and (not _is_gripper(name) or self.largest[j] <= 2.0 * np.pi):
                scale[j] = 1.0
            elif _is_gripper(name):  # closed is the lower end
                scale[j] = span / _FULL_RANGE
                offset[j] = limits.lower[j] / scale[j]
            elif units.unit == "range":
                middle = 0.0 if ranges is not None else 0.5 * (limits.lower[j] + limits.upper[j])
                scale[j] = 0.5 * span / _FULL_RANGE
                offset[j] = middle / scale[j]
        if not (np.isfinite(scale).all() and np.isfinite(offset).all()):
            j = int(np.argmin(np.isfinite(scale) & np.isfinite(offset)))
            problem = f"the URDF states no range of {joints[j]}, which the data set counts in"
            raise SourceError(self.folder, problem, field=STATE, remedy=_CALIBRATE)
        quantity = {"unit": "rad", "scale": scale.tolist(), "offset": offset.tolist()}
        columns = list(range(len(joints)))
        document = {
            "joints": list(joints),
            "time": {"column": _TIME, "unit": "s"},
            "position": {"array": STATE, "columns": columns, **quantity},
            "commanded_position": {
                "array": ACTION, "columns": list(self.commanded), **quantity
            },
        }  # fmt: skip
        return to_text(document, {"": "Proposed by hil from meta/info.json"}), units

    def _joints_of(self, robot: Robot) -> tuple[str, ...]:
        """Return the joint of the robot for each number of a state."""
        if set(robot.joint_names) & set(self.joints):
            return self.joints
        if len(robot.joint_names) == len(self.joints):
            return robot.joint_names
        problem = f"has {', '.join(self.joints)}, and the URDF {', '.join(robot.joint_names)}"
        remedy = "give the URDF of this arm, or fix joints that were not recorded (--locked)"
        raise SourceError(self.folder, problem, field=STATE, remedy=remedy)

    def _units(
        self, lower: Array, upper: Array, ranges: Array | None, stated: EpisodeUnit | None
    ) -> EpisodeUnits:
        """Return the units of the joints, stated or concluded."""
        if stated is not None:
            return EpisodeUnits(stated, UnitsFrom.OPTION)
        arm = np.array([not _is_gripper(name) for name in self.joints], np.bool_)
        largest = float(np.max(self.largest, where=arm, initial=0.0))
        if largest > _FULL_RANGE + _RANGE_ROUNDING:
            return EpisodeUnits("deg", UnitsFrom.BEYOND_RANGE)
        if (unit := self._unit_of_steps(arm, ranges)) is not None:
            return EpisodeUnits(unit, UnitsFrom.ENCODER)
        if ranges is not None and (arm & (np.radians(self.largest) > 0.5 * ranges)).any():
            return EpisodeUnits("range", UnitsFrom.CALIBRATION)
        reach = np.maximum(np.abs(lower), np.abs(upper)) + _MAX_LIMIT_EXCESS
        if (arm & (np.radians(self.largest) > reach)).any():
            return EpisodeUnits("range", UnitsFrom.BEYOND_LIMITS)
        small = ", in radians" if np.max(self.largest, where=arm, initial=0.0) <= np.pi else ""
        problem = f"its joints may be in degrees{small}, or -100 to 100 of their calibrated range"
        raise SourceError(self.folder, problem, field=STATE, remedy=_CALIBRATE)

    def _unit_of_steps(self, arm: NDArray[np.bool_], ranges: Array | None) -> EpisodeUnit | None:
        """Return the unit in which positions are steps of encoders, or None."""
        known = arm & np.isfinite(self.steps)
        if np.count_nonzero(known) < _FEWEST_ENCODERS:
            return None
        turn = 2.0 * np.pi / _STEPS_PER_TURN
        units: dict[EpisodeUnit, Array | float] = {"deg": np.degrees(turn), "rad": turn}
        if ranges is not None:
            units["range"] = (2.0 * _FULL_RANGE * turn / ranges)[known]
        alike: list[EpisodeUnit] = [
            unit
            for unit, step in units.items()
            if (np.abs(self.steps[known] / step - 1.0) < _STEP_TOLERANCE).all()
        ]
        return alike[0] if len(alike) == 1 else None


_CALIBRATE: Final = (
    "state --units deg or --units rad; or --units range, with LeRobot's calibration of the arm"
    " (--calibration FILE.json) or, without it, the ranges of the URDF"
)


def is_data_set(path: Path) -> bool:
    """Return whether a folder is a data set of LeRobot, of whatever version."""
    return path.is_dir() and any((path / info).is_file() for info in (INFO, _FORMER_INFO))


def _require_all(folder: Path, info: Mapping[str, Any], found: Collection[int]) -> None:
    """Raise SourceError if there are fewer episodes than the data set describes."""
    whole = info.get("total_episodes")
    count = whole if isinstance(whole, int) else 0
    if found and len(found) >= count:
        return
    missing = [str(number) for number in range(count) if number not in found]
    names = f": no {', '.join(missing[:_NAMED])}" if found and missing else ""
    more = " ..." if found and len(missing) > _NAMED else ""
    problem = f"has {len(found)} of {count or 'its'} episodes in data/**/*.parquet{names}{more}"
    remedy = "download the whole data set, its folder data included"
    raise SourceError(folder, problem, field="total_episodes", remedy=remedy)


def _info(folder: Path) -> Mapping[str, Any]:
    path = folder / INFO
    if not path.is_file():
        raise _of_other_version(folder / _FORMER_INFO, "1")
    try:
        info = parse_json(read_text(path))
    except (OSError, ValueError) as error:
        raise SourceError(path, f"cannot be read ({error})") from error
    if not isinstance(info, dict) or not isinstance(info.get("features"), dict):
        raise SourceError(path, "does not describe features", field="features")
    version = re.match(r"v?(\d+)", str(info.get("codebase_version", "v2")))
    if version is None or int(version[1]) not in _VERSIONS:
        raise _of_other_version(path, str(info["codebase_version"]).lstrip("v"))
    return info


def _of_other_version(path: Path, version: str) -> SourceError:
    remedy = "convert it to 3.0 by the scripts of LeRobot"
    problem = f"is of version {version}, and 2.0 to 3 are read"
    return SourceError(path, problem, field="codebase_version", remedy=remedy)


def _names(folder: Path, info: Mapping[str, Any], feature: str) -> tuple[str, ...]:
    """Return the names of the numbers of a feature, without what LeRobot adds to joints."""
    described = info["features"].get(feature)
    names = described.get("names") if isinstance(described, dict) else None
    if isinstance(names, dict):  # {"motors": [...]}, as of version 2.0
        names = next(iter(names.values()), None)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        problem = f"has no numbers for {feature}"
        remedy = "give a data set of an arm, whose states and actions are positions of its joints"
        raise SourceError(folder / INFO, problem, field=feature, remedy=remedy)
    return tuple(_PREFIXES.sub("", _SUFFIXES.sub("", name)) for name in names)


def _episodes(folder: Path, table: Path) -> list[Episode]:
    """Return the episodes in a table."""
    from pyarrow import ArrowException, parquet

    try:
        content = parquet.read_table(table, columns=[_TIME, _EPISODE, STATE, ACTION])
        arrays = {
            name: _matrix(content[name].to_numpy()) if name in (STATE, ACTION)
            else content[name].to_numpy()
            for name in content.column_names
        }  # fmt: skip
    except (ArrowException, OSError, ValueError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise SourceError(table, f"cannot be read as episodes ({reason})") from error
    episodes = []
    for number in np.unique(arrays[_EPISODE]).tolist():
        rows = arrays[_EPISODE] == number
        path = folder / f"{folder.resolve().name}_episode_{number:06d}.parquet"
        chosen = {name: arrays[name][rows] for name in (_TIME, STATE, ACTION)}
        files = LogFiles({path: ArrayFile.in_memory(path, chosen)})
        episodes.append(Episode(table, path, files, number))
    return episodes


def _matrix(lists: NDArray[Any]) -> Array:
    return np.stack([np.asarray(row, np.float64) for row in lists])


def _step(positions: Array) -> float:
    """Return the step that positions are whole multiples apart by; nan if there is none."""
    places = np.unique(np.round(positions, 5))
    apart = np.diff(places)
    apart = apart[apart > _LEAST_STEP]
    if len(apart) < _FEWEST_STEPS:
        return math.nan
    count = np.rint(apart / apart.min())
    if np.abs(apart / apart.min() - count).max() > _LARGEST_REMAINDER:
        return math.nan
    return float(apart.sum() / count.sum())


def _calibrated(path: Path, joints: Sequence[str]) -> Array:
    """Return the calibrated range of each joint (n,) [rad]."""
    try:
        content = parse_json(read_text(path))
        by_name = {_PREFIXES.sub("", str(name)): entry for name, entry in content.items()}
        spans = [float(by_name[j]["range_max"]) - float(by_name[j]["range_min"]) for j in joints]
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        problem = f"is not a LeRobot calibration of these joints ({error})"
        remedy = f"give its JSON with range_min and range_max of {', '.join(joints)}"
        raise SourceError(path, problem, field="--calibration", remedy=remedy) from error
    if not min(spans) > 0.0:
        joint = joints[int(np.argmin(spans))]
        remedy = "calibrate the arm again, or give another file"
        raise SourceError(path, "has an empty range", field=f"{joint}.range_max", remedy=remedy)
    return np.asarray(2.0 * np.pi / _STEPS_PER_TURN * np.array(spans))


def _require_like(path: Path, joint: str, calibrated: float, described: float) -> None:
    """Raise SourceError if a calibrated range differs by far from the URDF's [rad]."""
    least, most = _CALIBRATED
    if np.isfinite(described) and not least < calibrated / described < most:
        problem = f"calibrates {calibrated:.3g} rad, and the URDF has a range of {described:.3g}"
        remedy = "give the calibration and the URDF of this arm"
        raise SourceError(path, problem, field=joint, remedy=remedy)


def _is_gripper(name: str) -> bool:
    return any(word in name.lower() for word in _GRIPPER)
