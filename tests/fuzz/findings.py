"""What broke a law: one folder per cause, with the input, its shortest form and the traceback."""

from __future__ import annotations

import hashlib
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType

ROOT = Path(__file__).resolve().parents[2]
OURS = ("hil", "drivers", "planner", "identification", "sim_fixtures")
INPUT, SHORTEST, STORY, COUNT = "input", "shortest", "traceback.txt", "count"


def signature(error: BaseException) -> str:
    """A name of the cause: the kind of error and the line of ours that it left last.

    Of an error from too deep a recursion it is the first line, since the last is anywhere.
    """
    places = _places(error.__traceback__)
    ours = [place for place in places if place.split("/")[0] in OURS] or places or ["nowhere"]
    place = ours[0] if isinstance(error, RecursionError) else ours[-1]
    return named(type(error).__name__, place)


def named(kind: str, place: str) -> str:
    """A folder's name for a kind of error at a place ``file:line``."""
    return f"{kind}-{place.replace('/', '.')}".replace(":", "-")


def _places(trace: TracebackType | None) -> list[str]:
    """Files of this project and lines of a traceback, the outermost first."""
    found = []
    for frame in traceback.extract_tb(trace):
        path = Path(frame.filename)
        if path.is_relative_to(ROOT) and ".venv" not in path.parts:
            found.append(f"{path.relative_to(ROOT)}:{frame.lineno}")
    return found


@dataclass
class Findings:
    """The findings of one target, below `folder`.

    Attributes:
        new: names of causes that were met for the first time by this object.
    """

    folder: Path
    new: list[str] = field(default_factory=list)
    _counts: dict[str, int] = field(default_factory=dict)

    def keep(self, name: str, data: bytes, story: str) -> bool:
        """Keep an input that broke a law; True if its cause was not known."""
        place = self.folder / name
        known = place.exists()
        if not known:
            place.mkdir(parents=True, exist_ok=True)
            (place / INPUT).write_bytes(data)
            (place / STORY).write_text(story, "utf-8", errors="backslashreplace")
            self.new.append(name)
        self._count(place)
        return not known

    def _count(self, place: Path) -> None:
        """How often a cause was met, on disk at 1, 2, 4, 8 ... and every thousand times."""
        count = self._counts.get(place.name)
        if count is None:
            path = place / COUNT
            count = int(path.read_text()) if path.exists() else 0
        self._counts[place.name] = count = count + 1
        if count & (count - 1) == 0 or count % 1000 == 0:
            (place / COUNT).write_text(str(count))


def known(folder: Path) -> dict[str, int]:
    """Causes below a folder of findings and how often each was met at least."""
    return {
        place.name: int((place / COUNT).read_text()) if (place / COUNT).exists() else 1
        for place in sorted(folder.glob("*"))
        if (place / INPUT).exists()
    }


def digest(data: bytes) -> str:
    """Name of an input's file, as libFuzzer has it."""
    return hashlib.sha1(data, usedforsecurity=False).hexdigest()
