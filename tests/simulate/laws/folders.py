"""The folder: the manifest names the valid archives; none is overwritten, repeated or lost.

`docs/campaign.md`: every step is continued by the same command; a complete motion is neither run
again nor overwritten; `manifest.json` holds the checksums.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from tests.simulate.observed import Observed
from tests.simulate.script import kind_of

from .archived import read

WANTED: Final = ("standstill", "excitation", "validation")
"""Kinds whose number the plan determines; each motion is executed once."""
NAME: Final = re.compile(r"([a-z]+)_(\d{3,})_a([1-9]\d*)\.mcap")
_AT_SAVE: Final = ("save-full", "kill-at-save")
_OUTCOMES: Final = ("completed", "stopped", "refused", "lost", "rejected")


@dataclass(frozen=True)
class Entry:
    """A line of the manifest, and whether the file has its checksum."""

    name: str
    outcome: str
    sha256: str
    reason: str
    unchanged: bool

    @property
    def motion(self) -> tuple[str, int]:
        """Kind and index."""
        kind, index, _ = parsed(self.name)
        return kind, index


def parsed(name: str) -> tuple[str, int, int]:
    """Kind, index and attempt of a file name."""
    match = NAME.fullmatch(name)
    if match is None:
        return "", -1, -1
    return match[1], int(match[2]), int(match[3])


def manifest_of(observed: Observed) -> tuple[dict[str, Any], list[Entry]]:
    """Return the checksums of the inputs, and the entries."""
    content = json.loads((observed.folder / "manifest.json").read_text("utf-8"))
    entries = []
    for archive in content["archives"]:
        path = observed.folder / "archives" / archive["name"]
        same = path.exists() and hashlib.sha256(path.read_bytes()).hexdigest() == archive["sha256"]
        entries.append(
            Entry(
                archive["name"],
                archive["outcome"],
                archive["sha256"],
                archive.get("reason", ""),
                same,
            )
        )
    return content["inputs"], entries


def folder(observed: Observed) -> Iterator[str]:
    """Check the law of this module."""
    try:
        inputs, entries = manifest_of(observed)
    except (OSError, ValueError, KeyError, TypeError) as error:
        yield f"manifest.json cannot be read: {type(error).__name__}: {error}"
        return
    for name in ("cell.toml", "robot.urdf", "plan.json"):
        digest = hashlib.sha256((observed.folder / name).read_bytes()).hexdigest()
        if inputs.get(name) != digest:
            yield f"{name} is not the one in the manifest"
    torn = {name for life in observed.runs for name in life.torn}
    names = [entry.name for entry in entries]
    if len(set(names)) < len(names):
        yield "an archive is entered twice"
    for entry in entries:
        yield from _entry(observed, entry, torn)
    yield from _unchanged_files(observed)
    yield from _executed_once(observed, entries)
    yield from _left_over(observed, names)


def _entry(observed: Observed, entry: Entry, torn: set[str]) -> Iterator[str]:
    path = observed.folder / "archives" / entry.name
    if not path.exists():
        yield f"{entry.name} is in the manifest and not in the folder"
        return
    if not entry.unchanged:
        # A rejection is written into the archive, then into the manifest: the save may fail.
        unsaved = any(kind_of(line) in _AT_SAVE for line in observed.struck)
        if entry.name not in torn and not (unsaved and read(path).ended == "rejected"):
            yield f"{entry.name} differs from its checksum, and no fault damaged it"
        return
    archived = read(path)
    if entry.outcome not in _OUTCOMES:
        yield f"{entry.name} is entered as {entry.outcome!r}"
    if not archived.whole:
        yield f"{entry.name} is torn ({archived.problem}), and entered as {entry.outcome}"
    elif archived.ended != entry.outcome and archived.ended != "interrupted":
        yield f"{entry.name} says {archived.ended!r}, and is entered as {entry.outcome!r}"
    if entry.outcome == "rejected" and (archived.outcome or {}).get("reason") != entry.reason:
        yield f"{entry.name} was rejected for another reason than the manifest says"


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
    """Each motion has one completed archive, and is not run again after it."""
    valid: dict[tuple[str, int], list[str]] = {}
    for entry in entries:
        if entry.outcome == "completed" and entry.unchanged and entry.motion[0] in WANTED:
            valid.setdefault(entry.motion, []).append(entry.name)
    for motion, names in valid.items():
        if len(names) > 1:
            yield f"{motion} has {len(names)} completed archives: {', '.join(names)}"
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
