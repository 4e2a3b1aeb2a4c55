"""The folder: the manifest names the valid archives; none is overwritten, repeated or lost.

`docs/campaign.md`: every step is continued by the same command; a complete motion is neither run
again nor overwritten; `manifest.json` holds the checksums.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Final

from tests.faults import kind_of
from tests.laws.manifests import (
    NAME,
    Entry,
    completed,
    entered_as_archived,
    entered_once,
    manifest_of,
    parsed,
)
from tests.laws.second_reader import read
from tests.simulate.observed import Observed

_AT_SAVE: Final = ("save-full", "kill-at-save")
_OUTCOMES: Final = ("completed", "stopped", "refused", "lost", "rejected")


def folder(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    try:
        inputs, entries = manifest_of(observed.folder)
    except (OSError, ValueError, KeyError, TypeError) as error:
        yield f"manifest.json cannot be read: {type(error).__name__}: {error}"
        return
    for name in ("cell.toml", "robot.urdf", "plan.json"):
        digest = hashlib.sha256((observed.folder / name).read_bytes()).hexdigest()
        if inputs.get(name) != digest:
            yield f"{name} is not the one in the manifest"
    torn = {name for life in observed.runs for name in life.torn}
    yield from entered_once(entries)
    for entry in entries:
        yield from _entry(observed, entry, torn)
    yield from _unchanged_files(observed)
    yield from _executed_once(observed, entries)
    yield from _left_over(observed, [entry.name for entry in entries])


def _entry(observed: Observed, entry: Entry, torn: set[str]) -> Iterator[str]:
    path = observed.folder / "archives" / entry.name
    if path.exists() and not entry.unchanged:
        # A rejection is written into the archive, then into the manifest: the save may fail.
        unsaved = any(kind_of(line) in _AT_SAVE for line in observed.struck)
        if entry.name not in torn and not (unsaved and read(path).ended == "rejected"):
            yield f"{entry.name} differs from its checksum, and no fault damaged it"
        return
    if path.exists() and entry.outcome not in _OUTCOMES:
        yield f"{entry.name} is entered as {entry.outcome!r}"
    yield from entered_as_archived(entry, observed.folder)


def _unchanged_files(observed: Observed) -> Iterator[str]:
    """No file vanishes or changes, except for a rejection, which is written into it."""
    for number, life in enumerate(observed.runs, 1):
        for name, digest in life.before.items():
            if not NAME.fullmatch(name):
                continue
            now = life.after.get(name)
            if now is None:
                yield f"life {number}: {name} is gone"
            elif now != digest and name not in life.torn:
                path = observed.folder / "archives" / name
                if not path.exists() or read(path).ended != "rejected":
                    yield f"life {number}: {name} was changed"
    for earlier, later in zip(observed.runs, observed.runs[1:], strict=False):
        if dict(earlier.after) != dict(later.before):
            yield "the folder changed while no process ran"


def _executed_once(observed: Observed, entries: list[Entry]) -> Iterator[str]:
    """A motion with a completed archive is not run again after it."""
    valid: dict[tuple[str, int], list[str]] = {}
    for entry in completed(entries):
        valid.setdefault(entry.motion, []).append(entry.name)
    begun = [(number, name) for number, life in enumerate(observed.runs) for name in life.archives]
    for number, name in begun:
        for other_number, other in begun:
            if other_number < number and other in valid.get(parsed(name)[:2], ()):
                yield f"{name} was run although {other} was complete by then"


def _left_over(observed: Observed, entered: list[str]) -> Iterator[str]:
    """Archives without an entry are of a run that ended early."""
    lives = {name: life for life in observed.runs for name in life.archives}
    for path in sorted((observed.folder / "archives").glob("*.mcap")):
        if path.name in entered:
            continue
        life = lives.get(path.name)
        if life is None:
            yield f"{path.name} is of no run"
        elif life.result is not None:
            yield f"{path.name} was not entered by a complete run"
