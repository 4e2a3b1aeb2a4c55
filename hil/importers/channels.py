"""What a log records: its channels with name, unit, type and rate, and what their names say.

`CHANNEL_NAMES` is the only table of names; maps are inferred from it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from hil.base.errors import SourceError
from hil.importers.array_files import READERS, ArrayFile, format_of
from hil.importers.bags import SUFFIXES, open_bag
from hil.importers.column_map import Format
from hil.importers.commands import COMMANDED, as_joint_state, measured_topics
from hil.importers.dialect import is_date
from hil.importers.log_files import LogFiles, files_in, is_folder_of_logs
from hil.importers.name_words import is_other, kind_by_words
from hil.importers.rosbag2 import joint_state_topics
from hil.importers.stamps import concluded_unit
from hil.importers.stated_units import without_unit
from hil.importers.text_table import TextTable
from hil.importers.units import TIMES, Kind, unit_of

_NUMBER: Final = r"[\[(_. ]*(?P<number>\d{1,2})[\])]*"
CHANNEL_NAMES: Final[Mapping[Kind, tuple[str, ...]]] = {
    "time": (
        "t", "time", "times", "timestamp", "timestamps", "time_stamp", "stamp", "tstamp",
        "header.stamp", "clock", "tick", "ticks", "ipoc", "duration", "seconds", "date", "datetime",
        "zeit",
    ),
    "position": (
        "q", "pos", "position", "positions", "qpos", "jointposition", "motor_state.q",
        "motorstate.q", "actual_q", "q_actual", "q_meas", "q_act", "state.q",
        "joint_position", "joint_positions", "jointpos", "angle", "angles", "joint_angle",
        "joint_angles", "aipos.a", "theta", "winkel", "field.position", "observation.state",
        "observation.position",
    ),
    "velocity": (
        "qd", "dq", "vel", "v", "qvel", "jointvelocity", "motor_state.dq", "motorstate.dq",
        "velocity", "velocities", "actual_qd", "qd_actual", "qd_meas",
        "state.dq", "joint_velocity", "joint_velocities", "jointvel", "omega", "speed", "qdot",
        "dtheta", "field.velocity", "observation.velocity",
    ),
    "torque": (
        "tau", "torque", "torques", "effort", "efforts", "eff", "m", "moment", "tau_j",
        "state.tau_j", "qfrc_actuator", "appliedjointmotortorque", "motor_state.tau_est",
        "motorstate.tauest",
        "tau_meas", "tau_actual", "joint_torque", "joint_torques", "jointtorque", "geartorque.a",
        "drehmoment", "field.effort", "observation.effort", "observation.torque", "load",
        "present_load", "observation.load",
    ),
    "motor_current": (
        "i", "iq", "cur", "curr", "current", "currents", "actual_current", "actuali",
        "motor_current", "motor_currents", "motorcurrent", "joint_current", "strom", "amp",
        "observation.current",
    ),
    # LeRobot's; all others are stated by the user: names of commands differ too much
    "commanded_position": ("action", "actions", "action.pos", "action.position"),
}  # fmt: skip
"""Names of channels in the logs of the field, lower case, without number and unit."""
DRIVE_OBJECT: Final = re.compile(
    r"(?<![0-9a-z])(?:0x)?(606[4c]|607[78])h?(?![0-9a-z])", re.IGNORECASE
)
"""Index of an object of drives (CiA 402) in a name; it is no joint's number."""
_OF_DRIVE_OBJECT: Final[Mapping[str, Kind]] = {
    "6064": "position", "606c": "velocity", "6077": "torque", "6078": "motor_current",
}  # fmt: skip
_BY_NAME: Final = {name: kind for kind, names in CHANNEL_NAMES.items() for name in names}


@dataclass(frozen=True)
class Channel:
    """A channel of a log: a column, an array, or a field of a topic.

    Attributes:
        name: as a column map names it.
        size: numbers in a sample: 1, or all of an array.
        samples: how many there are.
        unit: that the log states, None if it states none.
        dtype: numpy's name of the type that the file has, ``text`` in a table.
        rate: samples per second by the log's time, None if it has none.
        kind: the quantity that the name, or else the unit, says; None if neither does.
        number: the joint's number in the name, None without one.
        joints: that the log names, in the order of the numbers of a sample.
        text: of the first and the last row of a table, where it is the same and no number.
        first: of the first row of a table, where it is no number.
        is_repeated: whether it is a time that a channel before has as well, as where a log has the
            time in addition to each quantity.
    """

    name: str
    size: int
    samples: int
    unit: str | None = None
    dtype: str = "float64"
    rate: float | None = None
    kind: Kind | None = None
    number: int | None = None
    joints: tuple[str, ...] = ()
    text: str | None = None
    first: str | None = None
    is_repeated: bool = False


def channels_of(
    path: Path, form: Format | None = None, files: LogFiles | None = None
) -> tuple[Channel, ...]:
    """Return the channels of a log, an array file, a bag or an MCAP file.

    `files` are those that were parsed before.

    Raises:
        SourceError: it cannot be read.
    """
    suffix = path.suffix.lower()
    if path.is_dir() and is_folder_of_logs(path):
        return tuple(_of_folder(path, form, files or LogFiles()))
    if path.is_dir() or suffix in SUFFIXES or Path(path.stem).suffix in SUFFIXES:
        bag = _of_bag(path)
        if bag or suffix != ".mcap":
            return bag
    files = files or LogFiles()
    if format_of(path) in READERS:
        return tuple(_of_arrays(files.arrays(path)))
    return tuple(_of_table(files.table(path, form or Format())))


def kind_of(name: str, unit: str | None = None) -> tuple[Kind | None, int | None]:
    """Return the quantity that the name of a channel says, and the joint's number in it.

    A name that says nothing is of the quantity of its unit, where only one has it.
    """
    bare = without_unit(name)[0].strip().lower().rsplit("/", 1)[-1]
    if found := DRIVE_OBJECT.search(bare):
        bare = DRIVE_OBJECT.sub("", bare)
    match = re.fullmatch(rf"(?P<base>.*?){_NUMBER}(?P<end>\D*)", bare)
    base, number = (
        (bare, None) if match is None else (match["base"] + match["end"], int(match["number"]))
    )
    for candidate in (base, base.strip(" _.-"), base.replace(" ", "_").strip("_")):
        if candidate in _BY_NAME:
            return _BY_NAME[candidate], number
    if found:
        return _OF_DRIVE_OBJECT[found[1]], number
    kinds: list[Kind] = [
        kind
        for kind in CHANNEL_NAMES
        if kind != "commanded_position" and unit and unit_of(unit, kind)
    ]
    if len(kinds) != 1 or is_other(bare, kinds[0]):
        return None, number
    return kinds[0], number


def named_channels(file: TextTable | ArrayFile) -> list[Channel]:
    """Return the channels of a file by their names, without reading a number."""
    if isinstance(file, TextTable):
        return [Channel(name, 1, len(file.lines), kind=kind_of(name)[0]) for name in file.names]
    shapes = {name: file.shape(name) for name in file.names}
    return [
        Channel(name, math.prod(shape) // max(shape), max(shape), kind=kind_of(name)[0])
        for name, shape in shapes.items()
    ]


def kinds_of_file(path: Path) -> list[Kind]:
    """Return the quantities that the name of a file says, such as ``curr_data.csv``."""
    stem = path.stem.lower()
    parts = [part for part in re.split(r"[^a-z]+", stem) if len(part) > 1 or part == "q"]
    kinds = [kind_of(part)[0] for part in (stem, *parts)]
    return list(dict.fromkeys(kind for kind in kinds if kind is not None))


def _of_folder(folder: Path, form: Format | None, files: LogFiles) -> Iterator[Channel]:
    """Yield the channels of the files of a folder, by the files' names where theirs say nothing."""
    for path in files_in(folder):
        try:
            channels = channels_of(path, form, files)
        except SourceError:  # such as notes
            continue
        kinds = kinds_of_file(path)
        for channel in channels:
            kind = channel.kind or (kinds[0] if kinds else None)
            yield replace(channel, kind=kind and kind_in_file(kind, path))


def kind_in_file(kind: Kind, path: Path) -> Kind:
    """Return the quantity of positions in a file that is named as one of commands."""
    is_command = COMMANDED.search(path.stem) or path.stem.lower().startswith("control")
    return "commanded_position" if kind == "position" and is_command else kind


def _of_table(table: TextTable) -> Iterator[Channel]:
    names = (table.names or tuple(map(str, range(table.width))))[: table.width]
    rate = None
    kinds = [kind_of(name, table.unit(place)) for place, name in enumerate(names)]
    first = table.dialect.cells(table.lines[0])
    texts = table.texts
    if names[0] == "" and all(kind != "time" for kind, _ in kinds) and is_date(first[0]):
        kinds[0] = "time", None  # an index of dates, which pandas writes without a name
    repeated = _repeated_times(
        table, [k for k, name in enumerate(names) if _is_time(name, kinds[k][0])]
    )
    for place, (kind, _) in enumerate(kinds):
        if kind == "time" and rate is None:
            rate = _rate(table, place)
    for place, name in enumerate(names):
        kind, number = kinds[place]
        beginning = first[place] if place < len(first) else ""
        yield Channel(
            name, 1, len(table.lines), table.unit(place), "text", rate, kind, number,
            text=texts[place],
            first=None if not beginning or table.is_number(beginning) else beginning,
            is_repeated=place in repeated,
        )  # fmt: skip


def _rate(table: TextTable | ArrayFile, place: int | str) -> float | None:
    """Return the rate by a column of times, in its own unit or the one that is concluded."""
    stated = unit_of(table.unit(place) or "", "time")
    try:
        times = table.times(place, TIMES[stated or "s"])
        if stated is None:
            times = table.times(place, TIMES[concluded_unit(times)])
    except SourceError:
        return None
    return rate_of([time for time in times if time is not None])


def _is_time(name: str, kind: Kind | None) -> bool:
    """Return whether a name, or a word in it, says a time; `kind` is what the whole name says."""
    return kind == "time" or (kind is None and kind_by_words(name) == "time")


_Place = TypeVar("_Place", int, str)


def _repeated_times(table: TextTable | ArrayFile, places: Sequence[_Place]) -> set[_Place]:
    """Return the columns whose times are all the same as in an earlier column."""
    repeated = set()
    earlier: list[Sequence[int | None]] = []
    for place in places if len(places) > 1 else ():
        try:
            times = table.times(place, 0)
        except SourceError:  # no time
            continue
        if times in earlier:
            repeated.add(place)
        earlier.append(times)
    return repeated


def rate_of(stamps: Sequence[int] | NDArray[np.int64]) -> float | None:
    """Return samples per second of stamps [ns], None where they do not advance."""
    steps = np.diff(np.array([float(stamp) for stamp in stamps]))
    steps = steps[steps > 0.0]
    return 1e9 / float(np.median(steps)) if steps.size else None


def _of_arrays(file: ArrayFile) -> Iterator[Channel]:
    kinds = {name: kind_of(name) for name in file.names}
    rates = {
        max(file.shape(name)): _rate(file, name)
        for name, (kind, _) in kinds.items()
        if kind == "time" and math.prod(file.shape(name)) == max(file.shape(name))
    }
    times = [
        name
        for name, (kind, _) in kinds.items()
        if _is_time(name, kind) and math.prod(file.shape(name)) == max(file.shape(name))
    ]
    repeated = _repeated_times(file, times)
    for name, (kind, number) in kinds.items():
        shape = file.shape(name)
        samples = max(shape)
        size = math.prod(shape) // max(shape)
        rate = rates.get(samples)
        yield Channel(
            name, size, samples, None, file.dtype(name), rate, kind, number,
            is_repeated=name in repeated,
        )  # fmt: skip


def _of_bag(path: Path) -> tuple[Channel, ...]:
    """Return the quantities of the joint states in a bag; none where it has no such topic."""
    channels: list[Channel] = []
    with open_bag(path) as bag:
        measured = measured_topics(bag.topics)
        others = [name for name in joint_state_topics(bag.topics) if name not in measured]
        for topic in (*measured, *others):
            names: dict[str, None] = {}
            received = []
            present = dict.fromkeys(("position", "velocity", "effort"), 0)
            for message in map(as_joint_state, bag.messages(topic)):
                names.update(dict.fromkeys(message.content.name))
                received.append(message.received)
                for quantity in present:
                    values = getattr(message.content, quantity)
                    present[quantity] += bool(len(values)) and not np.isnan(values).all()
            for quantity, samples in present.items():
                if samples:
                    name = f"{topic}/{quantity}"
                    kind = kind_of(name)[0] if topic in measured else None
                    channels.append(
                        Channel(name, len(names), samples, None, "float64", rate_of(received), kind,
                                None, tuple(names))
                    )  # fmt: skip
    return tuple(channels)
