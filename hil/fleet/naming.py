"""Robot and date of a recording."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cached_property
from itertools import count, pairwise
from pathlib import Path
from typing import Final, Literal

from hil.archive import open_archive
from hil.base.errors import InputError
from hil.base.files import digest
from hil.batch.archive_discovery import ArchiveRef
from hil.batch.places import as_file
from hil.fleet.extra_channels import ExtraChannels

ROBOT: Final = "{robot}"
DATE: Final = "{date}"
_FIELD: Final = "--robot"
_PLACEHOLDER: Final = re.compile(r"\{[^}]*\}|\*\*/|\*|\?")
_REMEDY: Final = (
    f"give folder, column=NAME, metadata=KEY, or a pattern of paths such as '{ROBOT}/{DATE}.csv'"
)
_YEAR_FIRST: Final = re.compile(
    r"(?<!\d)(20\d\d)([-_.]?)(0[1-9]|1[0-2])(?:\2(0[1-9]|[12]\d|3[01]))?"
    r"(?:[T_ -]?([01]\d|2[0-3])[-_:h.]?([0-5]\d)(?:[-_:m.]?([0-5]\d))?)?(?!\d)"
)
_DAY_FIRST: Final = re.compile(
    r"(?<!\d)(0?[1-9]|[12]\d|3[01])([-_.])(0?[1-9]|1[0-2])\2(20\d\d)(?!\d)"
)


@dataclass(frozen=True)
class RobotNaming:
    """How the robot of a recording is found.

    Attributes:
        by: its folder, a pattern of its path, a column of the log, or an entry of the metadata of
            an MCAP file; "" if all recordings of one arm are of one robot.
        name: the pattern, column or entry.
    """

    by: Literal["", "folder", "path", "column", "metadata"] = ""
    name: str = ""

    @classmethod
    def parse(cls, text: str | None) -> RobotNaming:
        """Parse the value of ``--robot``.

        Raises:
            InputError: it names no robot.
        """
        if text is None:
            return cls()
        if text == "folder":
            return cls("folder")
        key, _, name = text.partition("=")
        if key == "column" and name:
            return cls("column", name)
        if key == "metadata" and name:
            return cls("metadata", name)
        if ROBOT not in text:
            problem = f"{text!r} does not state where the robot is named"
            raise InputError(None, problem, field=_FIELD, remedy=_REMEDY)
        unknown = {*re.findall(r"\{[^}]*\}", text)} - {ROBOT, DATE}
        if unknown or text.count(DATE) > 1:
            problem = f"{text!r} has other placeholders than {ROBOT} and one {DATE}"
            raise InputError(
                None, problem, field=_FIELD, remedy=f"write * for other parts; {_REMEDY}"
            )
        return cls("path", text)

    @property
    def facts(self) -> ExtraChannels:
        """What is read of each log for it."""
        columns = (self.name,) if self.by == "column" else ()
        return ExtraChannels(columns, self.name if self.by == "metadata" else "")

    @cached_property
    def _pattern(self) -> re.Pattern[str]:
        """The pattern of paths as a regular expression, which ends where they do."""
        parts = []
        end = 0
        robots = count(1)
        for match in _PLACEHOLDER.finditer(self.name):
            parts.append(re.escape(self.name[end : match.start()]))
            end = match.end()
            others = {"**/": "(?:[^/]+/)*", "*": "[^/]*", "?": "[^/]"}
            name = f"robot{next(robots)}" if match[0] == ROBOT else match[0][1:-1]
            parts.append(others.get(match[0]) or f"(?P<{name}>[^/]+?)")
        parts.append(re.escape(self.name[end:]))
        return re.compile(f"(?:^|.*/){''.join(parts)}$")

    def place(self, ref: ArchiveRef) -> ArchiveRef:
        """Return a recording with robot and date; robots of one type are arms of their own.

        The first of these that is known: the date in the pattern, the clock, the name, the file.

        Raises:
            InputError: the robot is not named where it should be.
        """
        match = self._pattern.match(ref.origin) if self.by == "path" else None
        named = {} if match is None else match.groupdict()
        robot = self._robot(ref, named)
        if not robot and self.by and ref.arm:
            raise self._nameless(ref)
        if stated := named.get("date"):
            when = date_in(stated)
            if when is None:
                problem = f"{stated!r} is not a date"
                remedy = f"name it such as 2026-03-15, or write * in place of {DATE}"
                raise InputError(ref.origin, problem, field=_FIELD, remedy=remedy)
            # A clock that agrees has the time of day as well.
            if not ref.when.startswith(when[:10]):
                ref = replace(ref, when=when, dated_by="name")
        if not ref.when and (ref.source or ref.kind == "imported"):
            ref = dated(ref)
        if not robot or not ref.arm:
            return ref
        return replace(ref, robot=robot, arm_type=ref.arm, arm=digest(f"{ref.arm} {robot}"))

    def in_several_places(self, refs: Sequence[ArchiveRef]) -> dict[str, list[str]]:
        """Return the places of names that are in several whose recordings alternate in time.

        A folder for each month has the same names, too, one after the other.
        """
        if self.by not in ("path", "folder"):
            return {}
        dates: dict[str, dict[str, list[str]]] = {}
        for ref in refs:
            dates.setdefault(ref.robot, {}).setdefault(self._place_of_name(ref), []).append(
                ref.when
            )
        found = {}
        for robot, places in dates.items():
            spans = sorted((min(of_one), max(of_one), name) for name, of_one in places.items())
            names = {
                name
                for (_, end, first), (begin, _, second) in pairwise(spans)
                if begin < end
                for name in (first, second)
            }
            if names:
                found[robot] = sorted(names)
        return found

    def _place_of_name(self, ref: ArchiveRef) -> str:
        """Return the path of a recording up to the name of its robot."""
        match = self._pattern.match(ref.origin) if self.by == "path" else None
        return ref.campaign if match is None else ref.origin[: match.end("robot1")]

    def _robot(self, ref: ArchiveRef, named: dict[str, str]) -> str:
        if self.by == "folder":
            return ref.campaign.rsplit("/", 1)[-1]
        if self.by == "path":
            return "/".join(part for key, part in named.items() if key != "date")
        if self.by == "metadata" and not ref.source:
            with as_file(ref.location) as path:
                return open_archive(path, fields=(), stop=-1.0).header.entries.get(self.name, "")
        value = ref.facts.get(self.name, "") if self.by else ""
        is_number = isinstance(value, float) and value.is_integer()
        return f"{value:.0f}" if is_number else str(value)

    def _nameless(self, ref: ArchiveRef) -> InputError:
        where = {
            "path": f"does not match {self.name!r}",
            "column": f"has no column {self.name!r} that names its robot",
            "metadata": f"has no entry {self.name!r} in its metadata that names its robot",
        }
        return InputError(ref.origin, where[self.by], field=_FIELD, remedy=_REMEDY)


def date_in(text: str) -> str | None:
    """Return the date in a name, ISO 8601 in UTC, or None."""
    if (match := _YEAR_FIRST.search(text)) is not None:
        year, _, month, day, *clock = match.groups()
        hour, minute, second = (int(part or 0) for part in clock)
    elif (match := _DAY_FIRST.search(text)) is not None:
        day, _, month, year = match.groups()
        hour = minute = second = 0
    else:
        return None
    try:
        date = datetime(int(year), int(month), int(day or 1), hour, minute, second, tzinfo=UTC)
    except ValueError:  # 31 February
        return None
    return date.isoformat()


def dated(ref: ArchiveRef) -> ArchiveRef:
    """Return a log, or its archive, with the date of its name, of its folders, or of its file."""
    path = Path(ref.origin)
    names: Iterator[str] = iter((path.stem, path.name, *(each.name for each in path.parents[:2])))
    for name in names:
        if (when := date_in(name)) is not None:
            return replace(ref, when=when, dated_by="name")
    if not path.exists():  # a URL
        return ref
    files = [path] if path.is_file() else [each for each in path.iterdir() if each.is_file()]
    changed = max(each.stat().st_mtime for each in files)
    when = datetime.fromtimestamp(int(changed), UTC).isoformat()
    return replace(ref, when=when, dated_by="file")
