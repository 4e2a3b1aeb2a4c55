"""Logs and bags of a batch: read in parallel by one column map, and cached as archives.

The map is concluded from the first log, as `hil identify` does, and describes all others. Logs with
other channels get one of their own, likewise from the first of them. What was read before is not
read again while its file, the description of the robot and the programs are the same.
"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Final

from hil.archive import write_archive
from hil.archive.header import SUFFIX
from hil.base.errors import ArchiveError, SourceError
from hil.base.files import digest, file_digest, json_digest, replace_file, write_output
from hil.base.progress import Reporter
from hil.batch.archive_discovery import ArchiveRef, campaign_of, described_archive, is_untouched
from hil.batch.cache import CacheError, CacheLocation, cache_errors, code_digest
from hil.batch.cluster import Cluster, ClusterTask, SkippedArchive, reason_of
from hil.batch.places import Stamp, name_of, stamp_of
from hil.cell import Cell
from hil.fleet.extra_channels import ExtraChannels, facts_of
from hil.fleet.table import is_table
from hil.importers.array_files import READERS
from hil.importers.bag_map import BagMap
from hil.importers.bags import SUFFIXES as BAGS
from hil.importers.channels import channels_of, kinds_of_file
from hil.importers.column_map import ColumnMap, map_text
from hil.importers.imported_robot import Robot
from hil.importers.log_files import MARKS, TEXTS, LogFiles, files_in
from hil.importers.messages import sentence
from hil.importers.recording_import import (
    ImportedRecording,
    ImportOptions,
    ImportRequest,
    RobotOf,
    is_archive,
    read_by_map,
    read_recording,
)
from hil.importers.required_signals import has_servo, require_motion, require_torque
from hil.look.before_identification import concluded

_ARCHIVE: Final = ".recording"
"""Suffix of an archive in the cache, which no search takes for one of the user's."""
_LOG_SUFFIXES: Final = frozenset((*TEXTS, *READERS, *BAGS)) - {SUFFIX, ".json"}  # else settings
_PACKED: Final = (".zst", ".zstd")
_TABLES: Final = ("parameters", "axes", "not_used", "quantities")  # that a batch writes
_MAX_REFUSED_LOGS: Final = 3
"""Logs with the same channels from which a map is tried to be concluded, before all are refused."""


@dataclass(frozen=True)
class LogMap:
    """How the channels of logs are read.

    Attributes:
        text: the map, TOML, of columns or of a bag.
        first: the log that it was concluded from; "" of a stated one.
        channels: their names in that log, () of a stated map.
        gravity: in the base frame [m/s²], where that log contradicted the stated one.
        meanings: what was concluded of the channels, a sentence each.
    """

    text: str
    first: str = ""
    channels: tuple[str, ...] = ()
    gravity: tuple[float, ...] | None = None
    meanings: tuple[str, ...] = ()


@dataclass(frozen=True)
class ReadLog:
    """A log that was read.

    Attributes:
        ref: its archive in the cache.
        by: the map that it was read by.
    """

    ref: ArchiveRef
    by: LogMap


@dataclass(frozen=True)
class UnreadLog:
    """A log that no map describes.

    Attributes:
        reason: why.
        channels: their names, None if even these cannot be read.
    """

    reason: str
    channels: tuple[str, ...] | None

    def is_of(self, maps: Sequence[LogMap]) -> bool:
        """Return whether a map was concluded from these channels, so that no other is needed."""
        return any(self.channels == each.channels for each in maps)


@dataclass(frozen=True)
class _Note:
    """What is cached of a log, by its name and how logs are read."""

    code: str  #: digest of the programs
    stamp: Stamp  #: of the log
    read: ReadLog


@dataclass(frozen=True, eq=False)
class LogReading:
    """How logs are read; pickled to workers.

    Attributes:
        robot_of: the robot of all logs.
        options: how they are read where it is not concluded.
        robot: digest of its description, for the cache.
        facts: columns, and entries of the metadata, that are read in addition to the motion.
    """

    robot_of: RobotOf
    options: ImportOptions
    robot: str
    facts: ExtraChannels = field(default_factory=ExtraChannels)

    @classmethod
    def of(
        cls,
        robot_of: RobotOf,
        options: ImportOptions,
        description: str,
        facts: ExtraChannels = ExtraChannels(),  # noqa: B008 - frozen
    ) -> LogReading:
        """Return how the logs of a robot are read.

        Args:
            robot_of: reads its cell or URDF.
            options: of the import.
            description: text that distinguishes the robot in addition to its files.
            facts: columns and metadata entries to read in addition to the motion.

        Raises:
            InputError: the description of the robot or a stated map is invalid.
        """
        robot = robot_of(lambda: None)
        described = json_digest([robot.cell, robot.urdf, description])
        reading = cls(robot_of, options, described, facts)
        _ = reading.stated
        return reading

    @cached_property
    def key(self) -> str:
        """Digest of everything that decides how a log is read, but the log."""
        options = replace(self.options, columns=None)
        stated = self.stated.text if self.stated is not None else ""
        return json_digest([repr(options), self.robot, stated, self.facts])

    @cached_property
    def stated(self) -> LogMap | None:
        """The stated map, None if it is to be concluded.

        Raises:
            SourceError: it cannot be read or is not valid.
        """
        path = self.options.columns
        if path is None:
            return None
        if BagMap.load(path) is None:
            ColumnMap.load(path)
        return LogMap(map_text(path))


# In workers


def read_log(log: str, maps: Sequence[LogMap], reading: LogReading, cache: CacheLocation) -> (
    ReadLog | UnreadLog
):  # fmt: skip
    """Read a log by the first map that describes it, and write its archive to the cache.

    Args:
        log: its path.
        maps: in the order in which they are tried.
        reading: how logs of the robot are read.
        cache: where archives are kept.

    Raises:
        CacheError: the cache cannot be written.
    """
    source = Path(log)
    files = LogFiles()
    failures = []
    for log_map in maps:
        try:
            place = _place_of(source, reading, log_map, cache)
            if not place.is_file():
                recording = _by_map(source, place, reading, log_map, files)
                _require_usable(recording, source)
                _write(recording, place)
            return _read(log, place, log_map, reading, cache, files)
        except CacheError:
            raise
        except Exception as error:
            failures.append(reason_of(error, log))
    try:
        channels = _channels(source)
    except Exception as error:  # of a damaged file, of whatever library
        return UnreadLog(failures[0] if failures else reason_of(error, log), None)
    return UnreadLog(failures[0] if failures else "", channels)


def conclude_map(log: str, reading: LogReading, cache: CacheLocation) -> ReadLog:
    """Read a log as `hil identify` does, and write its archive to the cache with that map.

    Raises:
        HilError: it cannot be read, or its channels leave a quantity open.
        CacheError: the cache cannot be written.
    """
    source = Path(log)
    as_stated = read_recording(source, reading.robot_of, reading.options)
    _require_usable(as_stated, source)
    found = concluded(as_stated, source, reading.robot_of, reading.options)
    recording = found.recording
    _require_usable(recording, source)
    text = recording.text
    assert text is not None, "a log has a column map, a bag the map of its topic"
    gravity = _gravity_of(recording)
    log_map = LogMap(
        text=text,
        first=log,
        channels=_channels(source),
        gravity=None if gravity == _gravity_of(as_stated) else gravity,
        meanings=tuple(sentence(each) for each in recording.concluded),
    )
    place = _place_of(source, reading, log_map, cache)
    _write(recording, place)
    return _read(log, place, log_map, reading, cache, recording.request.files)


def _read(
    log: str,
    place: Path,
    log_map: LogMap,
    reading: LogReading,
    cache: CacheLocation,
    files: LogFiles,
) -> ReadLog:
    """Return a log that was read, with its archive and the requested facts."""
    ref = described_archive(place.as_posix(), cache, log)
    facts = facts_of(Path(log), reading.facts, files)
    content = json_digest([digest for _, digest in _digests(Path(log))])
    return ReadLog(replace(ref, facts=facts, content=content), log_map)


def _by_map(
    source: Path, place: Path, reading: LogReading, log_map: LogMap, files: LogFiles
) -> ImportedRecording:
    """Read a log by a map, with the gravity of that map."""

    def robot_of(recorded: Callable[[], tuple[str, ...] | None]) -> Robot:
        robot = reading.robot_of(recorded)
        return robot if log_map.gravity is None else robot.with_gravity(log_map.gravity)

    outside = reading.options.outside_limits
    request = ImportRequest(source, place, outside_limits=outside, files=files)
    return read_by_map(request, robot_of, log_map.text)


def _require_usable(recording: ImportedRecording, source: Path) -> None:
    """Raise SourceError for a log without motion or torque."""
    require_motion(recording.archive, source)
    require_torque(recording.archive, source)
    if has_servo(recording.archive):
        problem = "has commanded positions and no torque"
        remedy = "identify servo and friction of such recordings by `hil identify`"
        raise SourceError(source, problem, field="torque", remedy=remedy)


def _gravity_of(recording: ImportedRecording) -> tuple[float, ...]:
    archive = recording.archive
    cell = Cell.from_texts(archive.text("cell.toml"), archive.text("robot.urdf"), archive.path)
    return tuple(cell.file.robot.gravity)


def _channels(source: Path) -> tuple[str, ...]:
    return tuple(channel.name for channel in channels_of(source))


def _place_of(source: Path, reading: LogReading, log_map: LogMap, cache: CacheLocation) -> Path:
    """Return the path of the archive of a log in the cache.

    Raises:
        SourceError: the log cannot be read.
    """
    how = [reading.key, log_map.text, log_map.gravity, code_digest()]
    return cache.path(source.as_posix(), json_digest(["log", _digests(source), how]), _ARCHIVE)


def _digests(source: Path) -> list[tuple[str, str]]:
    """Return name and digest of each file of a log.

    Raises:
        SourceError: one cannot be read.
    """
    try:
        return [(path.name, file_digest(path)) for path in _files_of(source)]
    except OSError as error:
        raise SourceError(source, f"cannot be read: {error.strerror}") from error


def _write(recording: ImportedRecording, place: Path) -> None:
    """Write the archive of a log, or raise a `CacheError`."""
    with cache_errors(place):
        place.parent.mkdir(parents=True, exist_ok=True)
        with replace_file(place) as temporary:
            write_archive(recording.archive, temporary)


def _files_of(source: Path) -> list[Path]:
    if not source.is_dir():
        return [source]
    return sorted(path for path in source.iterdir() if path.is_file())


def _stamp(log: str) -> Stamp:
    """Return what shows whether a log, or any file of its folder, has changed."""
    stamps = [stamp_of(path.as_posix()) for path in _files_of(Path(log))]
    return Stamp("; ".join(stamp.text for stamp in stamps), max(each.changed for each in stamps))


# In the main process


@dataclass(eq=False)
class LogsOfBatch:
    """Finds logs and bags, and imports them with the workers of a cluster.

    Attributes:
        reading: how they are read.
        cache: for archives; one that keeps nothing cannot be used.
        others: files next to logs that are no logs, such as a file of conditions.
        maps: by which logs were read, with their number, after the import.
    """

    reading: LogReading
    cache: CacheLocation
    cluster: Cluster
    reporter: Reporter
    others: frozenset[Path] = frozenset()
    maps: dict[LogMap, int] = field(default_factory=dict)

    def is_log(self, file: Path, siblings: Collection[str]) -> bool:
        """Return whether a file may be a log or a bag; tables next to results are neither."""
        suffix = file.suffix.lower()
        if suffix in _PACKED:
            suffix = Path(file.stem).suffix.lower()
        is_table = file.stem in _TABLES and f"{_TABLES[0]}.parquet" in siblings
        return suffix in _LOG_SUFFIXES and not is_table and {*MARKS}.isdisjoint(siblings)

    def is_other(self, file: Path) -> bool:
        """Return whether a file is stated to be no log, or is a table of quantities over time."""
        return file in self.others or is_table(file)

    def is_folder_of_one(self, folder: Path) -> bool:
        """Return whether a folder is one recording: a bag, or a file for each quantity."""
        try:
            names = {path.name for path in folder.iterdir()}
            if "metadata.yaml" in names or any(".db3" in name for name in names):
                return True
            kinds = [kinds_of_file(path) for path in files_in(folder)]
        except OSError:
            return False
        first = {each[0] for each in kinds if each}
        return all(kinds) and {"position", "torque"} <= first and names.isdisjoint(MARKS)

    def is_archive(self, file: Path) -> bool:
        """Return whether a file is an archive of this software."""
        return is_archive(file)

    def imported(self, logs: Sequence[str]) -> Mapping[str, ArchiveRef | SkippedArchive]:
        """Return the archive of each log, or why there is none.

        Raises:
            SourceError: a stated map is invalid.
            ClusterError: the cluster cannot be used.
            CacheError: the cache cannot be written.
        """
        done: dict[str, ReadLog | SkippedArchive] = {}
        with self.reporter.task("reading logs", len(logs)) as task:
            begun = time.time_ns()
            for log in logs:
                if (note := self._cached(log)) is not None:
                    done[log] = note
            task.advance(len(done))
            new = [log for log in logs if log not in done]
            read = self._imported(new, _new_maps(done), task.advance)
            for log, result in read.items():
                if isinstance(result, ReadLog):
                    self._remember(log, result, begun)
            done |= read
        self.maps = dict(Counter(each.by for each in done.values() if isinstance(each, ReadLog)))
        return {log: each.ref if isinstance(each, ReadLog) else each for log, each in done.items()}

    def _imported(
        self, logs: Sequence[str], maps: Sequence[LogMap], advance: Callable[[float], None]
    ) -> dict[str, ReadLog | SkippedArchive]:
        """Read logs by known maps, and infer maps for the others."""
        stated = self.reading.stated
        maps = [*maps] if stated is None else [stated]
        done: dict[str, ReadLog | SkippedArchive] = {}
        waiting = list(logs)
        if waiting and not maps:
            done |= self._concluded(waiting[:1], len(logs))
            maps = _new_maps(done)
            waiting = waiting[1:]
            advance(1)
        tried: Counter[tuple[str, ...]] = Counter()
        while waiting:
            tasks = [
                ClusterTask(log, read_log, (log, maps, self.reading, self.cache)) for log in waiting
            ]
            results = self.cluster.results(tasks, archives=len(logs))
            unread: dict[tuple[str, ...], list[str]] = defaultdict(list)
            for log, result in zip(waiting, results, strict=True):
                if not isinstance(result, UnreadLog):
                    done[log] = result
                elif stated is not None or result.channels is None or result.is_of(maps):
                    done[log] = SkippedArchive(log, result.reason)
                else:
                    unread[result.channels].append(log)
            leading = self._concluded([group[0] for group in unread.values()], len(logs))
            done |= leading
            maps = [*_new_maps(leading), *maps]
            remaining = []
            for channels, (leader, *others) in unread.items():
                tried[channels] += 1
                refusal = leading[leader]
                if isinstance(refusal, SkippedArchive) and tried[channels] >= _MAX_REFUSED_LOGS:
                    done |= {log: refusal._replace(path=log) for log in others}
                else:
                    remaining += others
            advance(len(waiting) - len(remaining))
            waiting = remaining
        return done

    def _concluded(self, logs: Sequence[str], count: int) -> dict[str, ReadLog | SkippedArchive]:
        tasks = [ClusterTask(log, conclude_map, (log, self.reading, self.cache)) for log in logs]
        return dict(zip(logs, self.cluster.results(tasks, archives=count), strict=True))

    def _cached(self, log: str) -> ReadLog | None:
        """Return a log as it was read before, None if it, its archive or a program has changed."""
        note = self.cache.get(log, self._key(log), _Note)
        if note is None or note.code != code_digest():
            return None
        try:
            ref = note.read.ref
            if _stamp(log) != note.stamp or stamp_of(ref.location) != ref.stamp:
                return None
        except (ArchiveError, OSError):  # the worker says what is wrong
            return None
        campaign = campaign_of(log)
        return replace(note.read, ref=replace(ref, source=log, campaign=campaign))

    def _remember(self, log: str, read: ReadLog, begun: int) -> None:
        stamp = _stamp(log)
        if is_untouched(stamp, begun):
            self.cache.put(log, self._key(log), _Note(code_digest(), stamp, read))

    def _key(self, log: str) -> str:
        text = f"log {name_of(log)} {self.reading.key}"
        return digest(text.encode("utf-8", "surrogateescape"))


def _new_maps(done: Mapping[str, ReadLog | SkippedArchive]) -> list[LogMap]:
    return list(dict.fromkeys(each.by for each in done.values() if isinstance(each, ReadLog)))


def write_maps(folder: Path, maps: Iterable[LogMap]) -> list[Path]:
    """Write maps into an existing folder: ``map.toml``, others with a number; return the paths."""
    paths = []
    for number, log_map in enumerate(maps, 1):
        path = folder / ("map.toml" if number == 1 else f"map-{number}.toml")
        write_output(path, log_map.text)
        paths.append(path)
    return paths
