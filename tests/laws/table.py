"""The one list of laws, and the run of a scenario that is judged by them.

Simulated campaigns, killed processes, disks, fault matrix and long runs are sources of scenarios:
each says what controller, network, disk and processes do, and what was seen of it. All of it is
judged here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Final, NamedTuple

from hil.base.errors import HilError
from tests.disk import readers
from tests.endurance import piece
from tests.laws.archives import gap_free, not_truncated, nothing_lost, readable
from tests.laws.arm import closed, stands
from tests.laws.errors import of_disk
from tests.laws.estimates import alike
from tests.laws.evidence import ArchiveFile, Broken, Evidence
from tests.laws.manifests import (
    completed,
    entered_as_archived,
    entered_once,
    entries_kept,
    nothing_missing,
)
from tests.laws.motions import as_planned
from tests.laws.second_reader import read
from tests.process_death.laws import LAWS as OF_PROCESSES
from tests.simulate.laws import LAWS as OF_SIMULATED


class Law(NamedTuple):
    """A law, and the part of the evidence that it needs."""

    part: str
    check: Callable[[Evidence], Iterable[str]]


Check = Callable[[ArchiveFile, Evidence], Iterable[str]]


def _of_each_file(check: Check) -> Law:
    def check_all(evidence: Evidence) -> Iterator[str]:
        for file in evidence.files:
            for text in check(file, evidence):
                yield f"{file.archived.path.name}: {text}"

    return Law("files", check_all)


def _of(part: str, check: Callable[[Any], Iterable[str]]) -> Law:
    return Law(part, lambda evidence: check(getattr(evidence, part)))


def _whole(file: ArchiveFile, _: Evidence) -> Iterator[str]:
    return not_truncated(complete=file.complete, problem=file.missing, excused=file.excused)


def _kept(evidence: Evidence) -> Iterator[str]:
    for before, after in zip(evidence.manifests, evidence.manifests[1:], strict=False):
        yield from entries_kept(before, after)


def _as_archived(evidence: Evidence) -> Iterator[str]:
    assert evidence.folder is not None
    for entry in evidence.entries:
        yield from entered_as_archived(entry, evidence.folder)


def _as_planned(evidence: Evidence) -> Iterator[str]:
    assert evidence.folder is not None
    for entry in completed(evidence.entries):
        motion = evidence.motions.get(entry.motion)
        if motion is not None:
            archived = read(evidence.folder / "archives" / entry.name)
            yield from as_planned(archived, motion, evidence.period)


def _at_rest(evidence: Evidence) -> Iterator[str]:
    for rest in evidence.rests:
        yield from closed(rest.phase, any_open=rest.any_open, when=rest.when)
        yield from stands(rest.velocity, rest.allowed, rest.when, rest.unit)


def _refusal_reported(evidence: Evidence) -> Iterator[str]:
    """A disk that refuses ends a run with an error of the disk, and nothing else does."""
    assert evidence.disk is not None
    refused, error = evidence.disk
    if bool(refused) != (error is not None):
        yield f"{', '.join(refused) or 'nothing'} was refused, and it was raised: {error}"
    if isinstance(error, HilError):
        assert evidence.folder is not None
        yield from of_disk(error, evidence.folder)
    elif error is not None:
        yield f"an undocumented {type(error).__name__}: {error}"


LAWS: Final[dict[str, Law]] = {
    "archives are complete": _of_each_file(_whole),
    "archives are readable": _of_each_file(lambda file, of: readable(file.archived, of.period)),
    "archives have no gaps": _of_each_file(
        lambda file, _: gap_free(file.archived.cycles["cycle"], file.missed)
    ),
    "no record is lost": _of_each_file(lambda file, _: nothing_lost(file.records_lost)),
    "files can be opened": _of("unreadable", iter),
    "entries stay": Law("manifests", _kept),
    "motions are entered once": _of("entries", entered_once),
    "files are as entered": Law("manifests", _as_archived),
    "no motion is missing": Law(
        "counts", lambda evidence: nothing_missing(evidence.entries, evidence.counts)
    ),
    "motions are as planned": Law("motions", _as_planned),
    "the arm is at rest": Law("rests", _at_rest),
    "a refusal of the disk is reported": Law("disk", _refusal_reported),
    "estimates agree": _of("estimates", lambda estimates: alike(*estimates)),
    "the session obeys its judge": _of("session", iter),
    **{name: _of("simulated", check) for name, check in OF_SIMULATED.items()},
    **{name: _of("processes", check) for name, check in OF_PROCESSES.items()},
    **{name: _of("damage", check) for name, check in readers.LAWS.items()},
    **{name: _of("piece", check) for name, check in piece.LAWS.items()},
}
"""By name; `applying` says which of them a run is judged by."""


def applying(evidence: Evidence) -> list[str]:
    """Return the names of the laws whose part of the evidence is there."""
    return [name for name, law in LAWS.items() if _is_there(getattr(evidence, law.part))]


def _is_there(part: object) -> bool:
    return part is not None and part != () and part != {}


def broken(evidence: Evidence) -> list[Broken]:
    """Return the violations of all laws; an exception of a law is a violation of its name."""
    violations: list[Broken] = []
    for name in applying(evidence):
        try:
            violations.extend(Broken(name, text) for text in LAWS[name].check(evidence))
        except Exception as error:
            violations.append(Broken(f"{name} (exception)", f"{type(error).__name__}: {error}"))
    return violations


@dataclass(frozen=True)
class Scenario:
    """What happens in one run, and how it is played.

    Attributes:
        name: what to type, or which test, to play it again.
        lines: script of its faults (`tests.faults`), () for none.
        play: lets it happen, and returns what was seen.
    """

    name: str
    lines: tuple[str, ...]
    play: Callable[[], Evidence]


UNDOCUMENTED: Final = "runs end as documented"
"""Law that a scenario breaks which cannot be played to its end."""


def judged(scenario: Scenario) -> list[Broken]:
    """Play a scenario, and return the laws that it breaks."""
    try:
        evidence = scenario.play()
    except Exception as error:
        return [Broken(UNDOCUMENTED, f"{type(error).__name__}: {error}")]
    return broken(evidence)
