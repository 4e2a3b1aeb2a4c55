"""The manifest names the valid archives of a folder; what was entered stays as it was.

`docs/campaign.md`: a complete motion is neither run again nor overwritten; `manifest.json` holds
the checksums.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from tests.laws.second_reader import read

WANTED: Final = ("standstill", "excitation", "validation")
"""Kinds whose number the plan determines; each motion is executed once."""
NAME: Final = re.compile(r"([a-z]+)_(\d{3,})_a([1-9]\d*)\.mcap")


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


def manifest_of(folder: Path) -> tuple[dict[str, Any], list[Entry]]:
    """Return the checksums of the inputs of a campaign's folder, and the entries."""
    content = json.loads((folder / "manifest.json").read_text("utf-8"))
    entries = []
    for archive in content["archives"]:
        path = folder / "archives" / archive["name"]
        same = path.exists() and digest_of(path) == archive["sha256"]
        reason = archive.get("reason", "")
        entry = Entry(archive["name"], archive["outcome"], archive["sha256"], reason, same)
        entries.append(entry)
    return content["inputs"], entries


def digest_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def entries_kept(before: Sequence[Entry], now: Sequence[Entry]) -> Iterator[str]:
    """What was entered stays entered, first and in its order, and its file as it was."""
    if [entry.name for entry in now[: len(before)]] != [entry.name for entry in before]:
        yield "the entries are not those of before and then others"
    there = {entry.name: entry for entry in now}
    for entry in before:
        if there.get(entry.name) != entry:
            yield f"the entry or the file of {entry.name} is not what it was"


def entered_once(entries: Iterable[Entry]) -> Iterator[str]:
    """An archive is entered once, and each motion has one completed archive."""
    names = [entry.name for entry in entries]
    if len(set(names)) < len(names):
        yield "an archive is entered twice"
    valid: dict[tuple[str, int], list[str]] = {}
    for entry in completed(entries):
        valid.setdefault(entry.motion, []).append(entry.name)
    for motion, of_motion in valid.items():
        if len(of_motion) > 1:
            yield f"{motion} has {len(of_motion)} completed archives: {', '.join(of_motion)}"


def completed(entries: Iterable[Entry]) -> list[Entry]:
    """Return the valid entries of kinds whose number the plan determines."""
    return [
        entry
        for entry in entries
        if entry.outcome == "completed" and entry.unchanged and entry.motion[0] in WANTED
    ]


def nothing_missing(entries: Iterable[Entry], counts: Sequence[int]) -> Iterator[str]:
    """Each motion of the plan is completed; `counts` are those of `WANTED`."""
    there = Counter(entry.motion for entry in completed(entries))
    wanted = ((kind, index) for kind, n in zip(WANTED, counts, strict=True) for index in range(n))
    for kind, index in wanted:
        if not there[kind, index]:
            yield f"{kind} {index} is missing"


def entered_as_archived(entry: Entry, folder: Path) -> Iterator[str]:
    """An entered file is there, complete, and states the outcome that was entered."""
    path = folder / "archives" / entry.name
    if not path.exists():
        yield f"{entry.name} is in the manifest and not in the folder"
        return
    archived = read(path)
    if not archived.whole:
        yield f"{entry.name} is torn ({archived.problem}), and entered as {entry.outcome}"
    elif archived.ended != entry.outcome and archived.ended != "interrupted":
        yield f"{entry.name} says {archived.ended!r}, and is entered as {entry.outcome!r}"
    if entry.outcome == "rejected" and (archived.outcome or {}).get("reason") != entry.reason:
        yield f"{entry.name} was rejected for another reason than the manifest says"
