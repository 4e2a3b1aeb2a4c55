"""Corpora: what a target begins with, and the few inputs worth a place in the repository."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

from tests.fuzz import targets
from tests.fuzz.findings import ROOT, SHORTEST, digest
from tests.fuzz.lives import CORPORA, Places, command_of, environment_of

MOST_FILES = 40
MOST_BYTES = 200_000
LARGEST = 20_000
_ENDINGS = 20


def plant(folder: Path, inputs: list[bytes]) -> None:
    """Write inputs under their digests."""
    folder.mkdir(parents=True, exist_ok=True)
    for data in inputs:
        (folder / digest(data)).write_bytes(data)


def keep(name: str, journal: Path) -> str:
    """Choose anew what lies in the repository for a target; says how much that is.

    Inputs that once broke a law (found-*), or were put there on purpose (seed-*), stay; beside
    them come, one after the other, those that add most to what the others reach, by libFuzzer's
    own count, as far as there is room.
    """
    places = Places.beside(journal, name)
    try:
        kept, too_long = _kept(name, places)
        first = places.scratch / "kept"
        first.mkdir()
        for file_name, data in kept.items():
            (first / file_name).write_bytes(data)
        others = [*places.corpus.iterdir(), *(CORPORA / name).iterdir()]
        added = {digest(path.read_bytes()): path for path in others if "-" not in path.name}
        reached = _reached(name, [*sorted(first.iterdir()), *sorted(added.values())], places)
        known = frozenset[int]().union(*(reached.pop(path, ()) for path in first.iterdir()))
        room = MOST_BYTES - sum(map(len, kept.values()))
        for path in chosen(reached, MOST_FILES - len(kept), room, known):
            data = path.read_bytes()
            kept[digest(data)] = data
    finally:
        shutil.rmtree(places.scratch, ignore_errors=True)
    (CORPORA / name).mkdir(parents=True, exist_ok=True)
    for path in (CORPORA / name).iterdir():
        path.unlink()
    for file_name, data in kept.items():
        (CORPORA / name / file_name).write_bytes(data)
    told = f"{len(kept)} inputs, {sum(map(len, kept.values()))} bytes"
    if too_long:
        told += f"; left out, being longer than {LARGEST} bytes: {', '.join(too_long)}"
    return told


def _kept(name: str, places: Places) -> tuple[dict[str, bytes], list[str]]:
    """What stays in any case, by file name, and the findings that are too long for it."""
    kept = {path.name: path.read_bytes() for path in (CORPORA / name).glob("*-*")}
    too_long = []
    for folder in sorted(places.findings.iterdir()):
        shortest = folder / SHORTEST
        if not shortest.exists():
            continue
        data = shortest.read_bytes()
        if len(data) > LARGEST:
            too_long.append(f"{folder.name} ({len(data)} bytes)")
        else:
            kept[f"found-{digest(data)[:12]}"] = data
    return kept, too_long


def _reached(name: str, tried: list[Path], places: Places) -> dict[Path, frozenset[int]]:
    """What each input reaches."""
    control = places.scratch / "control"
    control.write_text("\n".join([str(len(tried)), "0", *map(str, tried)]) + "\n")
    # merge_inner=2 asks for all that an input reaches, 1 only for what no earlier one did.
    for _ in range(_ENDINGS):  # one that ends the process is passed over by the next
        ended = subprocess.run(
            [*command_of(name), "--fuzz", str(places.findings), "-merge_inner=2",
             "-close_fd_mask=3", f"-max_len={targets.load(name).most}",
             f"-merge_control_file={control}"],
            cwd=ROOT, env=environment_of(places), capture_output=True, check=False,
        )  # fmt: skip
        if not ended.returncode:
            break
    return features_of(control.read_text("utf-8"))


def features_of(control: str) -> dict[Path, frozenset[int]]:
    """What each input reaches, from libFuzzer's control file of a merge."""
    lines = control.splitlines()
    count = int(lines[0])
    paths = [Path(line) for line in lines[2 : 2 + count]]
    reached = {}
    for line in lines[2 + count :]:
        kind, *numbers = line.split()
        if kind == "FT":
            reached[paths[int(numbers[0])]] = frozenset(map(int, numbers[1:]))
    return reached


def chosen(
    reached: dict[Path, frozenset[int]], files: int, size: int, known: frozenset[int] = frozenset()
) -> list[Path]:
    """Inputs that together reach most beyond `known`, greedily, within a number of files, bytes."""
    left = {
        path: set(features - known)
        for path, features in reached.items()
        if path.exists() and path.stat().st_size <= LARGEST
    }
    taken: list[Path] = []
    while left and len(taken) < files:
        best = max(left, key=lambda path: (len(left[path]), -path.stat().st_size))
        gained = left.pop(best)
        if not gained:
            break
        if best.stat().st_size > size:
            continue
        size -= best.stat().st_size
        taken.append(best)
        for others in left.values():
            others -= gained
    return taken
