"""Corpora: what a target begins with, and the few inputs worth a place in the repository."""

from __future__ import annotations

import subprocess
import tempfile
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
    target = targets.load(name)
    kept = {path.name: path.read_bytes() for path in (CORPORA / name).glob("*-*")}
    for folder in sorted(places.findings.iterdir()):
        shortest = folder / SHORTEST
        if shortest.exists() and shortest.stat().st_size <= LARGEST:
            data = shortest.read_bytes()
            kept[f"found-{digest(data)[:12]}"] = data
    with tempfile.TemporaryDirectory() as scratch:
        control = Path(scratch) / "control"
        tried = sorted({*places.corpus.iterdir(), *(CORPORA / name).iterdir()})
        control.write_text("\n".join([str(len(tried)), "0", *map(str, tried)]) + "\n")
        for _ in range(_ENDINGS):  # one that ends the process is passed over by the next
            ended = subprocess.run(
                [*command_of(name), "--fuzz", str(places.findings), "-merge_inner=1",
                 "-close_fd_mask=3", f"-max_len={target.most}",
                 f"-merge_control_file={control}"],
                cwd=ROOT, env=environment_of(places), capture_output=True, check=False,
            )  # fmt: skip
            if not ended.returncode:
                break
        reached = features_of(control.read_text("utf-8"))
    for path in chosen(reached, MOST_FILES - len(kept), MOST_BYTES - sum(map(len, kept.values()))):
        kept[digest(path.read_bytes())] = path.read_bytes()
    (CORPORA / name).mkdir(parents=True, exist_ok=True)
    for path in (CORPORA / name).iterdir():
        path.unlink()
    for file_name, data in kept.items():
        (CORPORA / name / file_name).write_bytes(data)
    return f"{len(kept)} inputs, {sum(map(len, kept.values()))} bytes"


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


def chosen(reached: dict[Path, frozenset[int]], files: int, size: int) -> list[Path]:
    """Inputs that together reach most, greedily, within a number of files and bytes."""
    left = {
        path: set(features)
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
