"""Options of the commands that read many recordings of many robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from hil.base.progress import Reporter
from hil.base.terminal_text import plural
from hil.batch.cache import CacheLocation
from hil.batch.cluster import Cluster, SkippedArchive
from hil.cli.imports import Described, Reading
from hil.fleet.logs import LogMap, LogReading, LogsOfBatch
from hil.fleet.naming import RobotNaming

RecordingsArgument = Annotated[list[str], typer.Argument(metavar="RECORDING")]


@dataclass(frozen=True, eq=False)
class FleetWork:
    """What reads recordings: the workers, their cache, and the import of logs if there is one."""

    cluster: Cluster
    cache: CacheLocation
    naming: RobotNaming
    logs: LogsOfBatch | None

    @property
    def maps(self) -> Mapping[LogMap, int]:
        """Maps by which logs were read, and their number."""
        return {} if self.logs is None else self.logs.maps


@dataclass(frozen=True)
class Fleet:
    """Options of a fleet; see `hil.cli.arguments.with_options`."""

    robot: Annotated[
        str | None,
        typer.Option(
            metavar="WHERE",
            help="What names the robot: folder, column=NAME, metadata=KEY, or a path pattern "
            "such as '{robot}/{date}.csv'. Default: one robot.",
        ),
    ] = None
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="Number of processes. Default: one per core, and none if few recordings are read.",
        ),
    ] = None
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Address of a running Dask scheduler, such as tcp://host:8786. Its workers need "
            "this version of hil and these paths.",
        ),
    ] = None
    cache: Annotated[
        str | None,
        typer.Option(
            metavar="FOLDER|none",
            help="Folder of cached factors, or none. Default: .hil-cache next to the recordings, "
            "or in the user's cache folder if the recordings are read-only.",
        ),
    ] = None

    @contextmanager
    def opened(
        self,
        arm: Described,
        reading: Reading,
        reporter: Reporter,
        columns: Sequence[str] = (),
        others: Iterable[Path | None] = (),
    ) -> Iterator[FleetWork]:
        """Provide workers and cache; logs are read if their robot is described.

        Of logs these `columns` are read in addition to the motion; `others` are no logs.

        Raises:
            InputError: an option is invalid, or one of logs is given without their robot.
        """
        naming = RobotNaming.parse(self.robot)
        if not arm.is_given:
            reading.refuse_without_robot()
        with (
            Cluster(self.workers, scheduler=self.scheduler, reporter=reporter) as cluster,
            self._cache(for_logs=arm.is_given) as cache,
        ):
            logs = None
            if arm.is_given:
                facts = naming.facts._replace(columns=(*naming.facts.columns, *columns))
                how = LogReading.of(arm.robot, reading.options, repr(arm), facts)
                besides = frozenset(path.resolve() for path in others if path is not None)
                logs = LogsOfBatch(how, cache, cluster, reporter, besides)
            yield FleetWork(cluster, cache, naming, logs)

    @contextmanager
    def _cache(self, *, for_logs: bool) -> Iterator[CacheLocation]:
        """Provide the cache; archives of logs need one, which may go with the command."""
        if self.cache != "none":
            yield CacheLocation(str(Path(self.cache).resolve()) if self.cache else None)
        elif for_logs:
            with TemporaryDirectory(prefix="hil-") as folder:
                yield CacheLocation(folder)
        else:
            yield CacheLocation(keep=False)


def map_lines(maps: Mapping[LogMap, int], *, verbose: bool) -> Iterator[str]:
    """Name the map of each kind of logs; with `verbose` also what it says of the channels."""
    for log_map, count in maps.items():
        source = f"inferred from {log_map.first}" if log_map.first else "given by --map"
        yield f"{plural(count, 'log')} read by the column map {source}"
        if verbose:
            yield from (f"  {meaning}" for meaning in log_map.meanings)


def skipped_line(skipped: Sequence[SkippedArchive]) -> str:
    """Count the recordings that were not fitted, by what they are."""
    counts = Counter(unused.noun for unused in skipped)
    kinds = ", ".join(plural(count, noun) for noun, count in counts.most_common())
    return f"{plural(len(skipped), 'recording')} not fitted: {kinds}"


def last(lines: Sequence[str], most: int, where: str) -> Iterator[str]:
    """Yield the last lines, after the number of the others and where they are."""
    if (more := len(lines) - most) > 0:
        yield f"  {more} more: see {where}"
    yield from lines[-most:]
