"""Lives of fuzzing processes, what they found and reached, and what of it is worth keeping."""

from __future__ import annotations

import hashlib
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz import targets
from tests.journal import Journal, entries

ROOT = Path(__file__).resolve().parents[2]
CORPORA = Path(__file__).parent / "corpora"
OURS = ("hil", "drivers", "planner", "identification", "sim_fixtures")
INPUT, SHORTEST, STORY, COUNT = "input", "shortest", "traceback.txt", "count"
MOST_FILES, MOST_BYTES, LARGEST = 40, 200_000, 20_000  # of a corpus in the repository
_PULSE = re.compile(
    r"^#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+) corp: (\d+)/\S+.*? rss: (\d+)Mb", re.MULTILINE
)
_TOTAL = re.compile(r"^stat::number_of_executed_units:\s+(\d+)", re.MULTILINE)
_OPEN = re.compile(r"^#(\d+)\s", re.MULTILINE)
_PLACE = re.compile(r'File "([^"]+)", line (\d+)')
_ENDINGS = {"crash": "crash", "timeout": "timeout", "oom": "memory", "slow": "whole"}
_PATIENCE = 10.0  # s for libFuzzer to say what it did, where it is asked to end
_GRACE = 240.0  # s beyond the time that a process was given, for its start on a loaded machine


@dataclass(frozen=True)
class Piece:
    """One life of a fuzzing process, a line of the journal."""

    target: str
    seconds: float
    inputs: int  # executed
    edges: int  # covered at its end, as libFuzzer counts them
    features: int  # likewise; an edge run through more often is another feature
    corpus: int  # inputs at its end
    memory: int  # resident at its end [MB]
    ended: str = "whole"  # "stopped" by the user; or "crash", "timeout", "memory", "killed"
    reproduced: bool = False  # whether what ended it early ends the target again by itself


def append(path: Path, piece: Piece) -> None:
    """Add a piece; it survives the death of this process and of the computer."""
    with Journal(path) as journal:
        journal.add(**asdict(piece))


def pieces(path: Path) -> list[Piece]:
    """All pieces of a journal; JournalError if it cannot be read, or a line is none."""
    return entries(path, lambda line: Piece(**line), "piece of fuzzing")


def summary(path: Path) -> dict[str, dict[str, Any]]:
    """Per target: inputs and seconds summed, coverage at its largest."""
    totals: dict[str, dict[str, Any]] = {}
    for piece in pieces(path):
        total = totals.setdefault(
            piece.target,
            {"pieces": 0, "seconds": 0.0, "inputs": 0, "edges": 0, "features": 0, "corpus": 0,
             "memory": 0, "ended_early": 0, "not_reproduced": 0},
        )  # fmt: skip
        total["pieces"] += 1
        total["seconds"] = round(total["seconds"] + piece.seconds, 1)
        total["inputs"] += piece.inputs
        for name in ("edges", "features", "corpus", "memory"):
            total[name] = max(total[name], getattr(piece, name))
        early = piece.ended not in ("whole", "stopped")
        total["ended_early"] += early
        total["not_reproduced"] += early and not piece.reproduced
    return totals


# Findings: one folder per cause, with the input, its shortest form and the traceback


def signature(error: BaseException) -> str:
    """A name of the cause: the kind of error and the line of ours that it left last.

    Of an error from too deep a recursion it is the first line, since the last is anywhere.
    """
    frames = traceback.extract_tb(error.__traceback__)
    places = _places([(one.filename, str(one.lineno)) for one in frames])
    ours = [place for place in places if place.split("/")[0] in OURS] or places or ["nowhere"]
    place = ours[0] if isinstance(error, RecursionError) else ours[-1]
    return _named(type(error).__name__, place)


def _named(kind: str, place: str) -> str:
    return f"{kind}-{place.replace('/', '.')}".replace(":", "-")


def _places(frames: list[tuple[str, str]]) -> list[str]:
    """``file:line`` of those frames that are of this project."""
    return [
        f"{Path(name).relative_to(ROOT)}:{line}"
        for name, line in frames
        if Path(name).is_relative_to(ROOT) and ".venv" not in Path(name).parts
    ]


@dataclass
class Findings:
    """The findings of one target, below `folder`."""

    folder: Path
    new: list[str] = field(default_factory=list)  # causes met for the first time by this object
    _counts: dict[str, int] = field(default_factory=dict)

    def keep(self, name: str, data: bytes, story: str) -> bool:
        """Keep an input that broke a law; True if its cause was not known.

        How often a cause was met is on disk at 1, 2, 4, 8 ... and every thousand times.
        """
        place = self.folder / name
        is_new = not place.exists()
        if is_new:
            place.mkdir(parents=True, exist_ok=True)
            (place / INPUT).write_bytes(data)
            (place / STORY).write_text(story, "utf-8", errors="backslashreplace")
            self.new.append(name)
        if name not in self._counts:
            self._counts[name] = int(_text(place / COUNT) or 0)
        self._counts[name] = count = self._counts[name] + 1
        if count & (count - 1) == 0 or count % 1000 == 0:
            (place / COUNT).write_text(str(count))
        return is_new


def known(folder: Path) -> dict[str, int]:
    """Causes below a folder of findings and how often each was met at least."""
    places = [place for place in sorted(folder.glob("*")) if (place / INPUT).exists()]
    return {place.name: int(_text(place / COUNT) or 1) for place in places}


def _text(path: Path) -> str:
    return path.read_text() if path.exists() else ""


# Processes


@dataclass(frozen=True)
class Places:
    corpus: Path  # all inputs so far, outside of the repository
    findings: Path  # a folder per cause
    scratch: Path  # for artefacts of libFuzzer and temporary files; in memory where it can be


@contextmanager
def beside(journal: Path, target: str) -> Iterator[Places]:
    """The places that belong to a journal, made if they are not there; the scratch goes again."""
    own = Path(f"{journal}.files") / target
    for name in ("corpus", "findings"):
        (own / name).mkdir(parents=True, exist_ok=True)
    base = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    scratch = Path(tempfile.mkdtemp("fuzz", dir=base))
    try:
        yield Places(own / "corpus", own / "findings", scratch)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _child(target: str, *arguments: str, places: Places, **more: Any) -> subprocess.Popen[str]:
    """One process of a target: a thread for linear algebra, temporary files in the scratch."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    environment = {"TMPDIR": str(places.scratch), "PYTHONHASHSEED": "0"}
    return subprocess.Popen(
        [sys.executable, "-m", "tests.fuzz.child", target, *arguments], cwd=ROOT,
        env={**os.environ, **threads, **environment}, text=True, errors="replace",
        start_new_session=True, **more,
    )  # fmt: skip


def _run(target: str, *arguments: str, places: Places, timeout: float) -> tuple[int, str]:
    """Exit status and errors of a process that ends by itself, or is killed."""
    process = _child(target, *arguments, places=places, stderr=subprocess.PIPE)
    try:
        _, errors = process.communicate(timeout=timeout)
    except subprocess.TimeoutExpired:
        return -signal.SIGKILL, f"did not end within {timeout:g} s"
    finally:
        _kill(process)
    return process.returncode, errors


def _kill(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def live(target: str, seconds: float, most: int, places: Places, ended: threading.Event) -> Piece:
    """Fuzz a target in a process of its own for some time, or until that or `ended` ends it."""
    begun = time.monotonic()
    log = places.scratch / "log"
    with log.open("wb") as stream:
        process = _child(
            target, "--fuzz", str(places.findings), f"-max_total_time={max(1, round(seconds))}",
            f"-max_len={most}", "-print_final_stats=1", f"-artifact_prefix={places.scratch}/",
            "-reload=0", "-close_fd_mask=3", str(places.corpus), str(CORPORA / target),
            places=places, stdout=stream, stderr=stream,
        )  # fmt: skip
        stopped = _watched(process, seconds + _GRACE, ended)
    text = log.read_text("utf-8", errors="replace")
    pulses = _PULSE.findall(text)
    _, edges, features, corpus, memory = map(int, pulses[-1]) if pulses else (0,) * 5
    totals = _TOTAL.findall(text) or _OPEN.findall(text) or ["0"]
    inputs = int(totals[-1])
    how, reproduced = "stopped" if stopped else "whole", False
    if process.returncode and not stopped:
        how, reproduced = _understood(target, process.returncode, text, places)
    if process.returncode > 0 and not inputs and not reproduced and not stopped:
        raise RuntimeError(f"{target} cannot be fuzzed:\n{text[-3000:]}")
    lasted = round(time.monotonic() - begun, 1)
    return Piece(target, lasted, inputs, edges, features, corpus, memory, how, reproduced)


def _watched(process: subprocess.Popen[str], seconds: float, ended: threading.Event) -> bool:
    """Wait until a process ends, and end it after `seconds`; True if `ended` ended it."""
    until = time.monotonic() + seconds
    try:
        while process.poll() is None and time.monotonic() < until and not ended.is_set():
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.2)
        stopped = process.poll() is None and ended.is_set()
        if stopped:
            os.killpg(process.pid, signal.SIGTERM)
            with suppress(subprocess.TimeoutExpired):
                process.wait(_PATIENCE)
    finally:
        _kill(process)
    return stopped


def _understood(target: str, status: int, text: str, places: Places) -> tuple[str, bool]:
    """How a process ended that did not end by itself; its input is tried again, and stays."""
    found = sorted(places.scratch.glob("*-*"), key=lambda path: path.stat().st_mtime)
    artefacts = [path for path in found if path.name.split("-")[0] in _ENDINGS]
    if not artefacts:
        return "killed" if status < 0 else "crash", False
    ended = _ENDINGS[artefacts[-1].name.split("-")[0]]
    data = artefacts[-1].read_bytes()
    for path in artefacts:
        path.unlink()
    again = places.scratch / "again"
    again.write_bytes(data)
    status, story = _run(target, "--once", str(again), places=places, timeout=_GRACE)
    if status:
        ours = _places(_PLACE.findall(story)) or ["nowhere"]
        # What faulthandler writes begins with the innermost line, what Python writes ends with it.
        innermost = ours[-1 if "Traceback (most recent call last)" in story else 0]
        kind = signal.Signals(-status).name if status < 0 else ended
        Findings(places.findings).keep(_named(kind, innermost), data, story[-20_000:])
    else:
        lost = places.findings.parent / "not_reproduced"
        lost.mkdir(exist_ok=True)
        (lost / f"{ended}-{len(list(lost.iterdir()))}").write_bytes(data)
        (lost / "last.log").write_text(text[-10_000:], "utf-8")
    return ended, status != 0


def shorten(target: str, places: Places, ended: threading.Event) -> None:
    """Make the shortest input of each finding that has none yet, unless `ended` is set."""
    for folder in sorted(places.findings.iterdir()):
        if ended.is_set():
            return
        if (folder / INPUT).exists() and not (folder / SHORTEST).exists():
            # A fault or a hang cannot be shortened from within; its input stays as it is.
            if not folder.name.startswith("SIG"):
                _run(target, "--shorten", str(folder), places=places, timeout=4 * _GRACE)
            if not (folder / SHORTEST).exists():
                shutil.copy(folder / INPUT, folder / SHORTEST)


# Corpora


def digest(data: bytes) -> str:
    """Name of an input's file, as libFuzzer has it."""
    return hashlib.sha1(data, usedforsecurity=False).hexdigest()


def plant(folder: Path, inputs: list[bytes]) -> None:
    """Write inputs under their digests."""
    folder.mkdir(parents=True, exist_ok=True)
    for data in inputs:
        (folder / digest(data)).write_bytes(data)


def keep(name: str, journal: Path) -> str:
    """Choose the corpus of a target in the repository again; return its size as text.

    Inputs that once violated a law (found-*) and given ones (seed-*) stay; others that reach more
    by libFuzzer's count are added, short ones first, up to the limits.
    """
    own = CORPORA / name
    inputs = {path.name: path.read_bytes() for path in own.glob("*-*")}
    too_long = []
    with beside(journal, name) as places:
        for shortest in sorted(places.findings.glob(f"*/{SHORTEST}")):
            data = shortest.read_bytes()
            if len(data) > LARGEST:
                too_long.append(f"{shortest.parent.name} ({len(data)} bytes)")
            else:
                inputs[f"found-{digest(data)[:12]}"] = data
        merged = places.scratch / "merged"
        merged.mkdir()
        for file_name, data in inputs.items():
            (merged / file_name).write_bytes(data)
        _merge(name, merged, [places.corpus, own], places)
        for path in sorted(merged.iterdir(), key=lambda one: (one.stat().st_size, one.name)):
            data = path.read_bytes()
            room = MOST_BYTES - sum(map(len, inputs.values()))
            if len(inputs) < MOST_FILES and len(data) <= min(room, LARGEST):
                inputs.setdefault(path.name, data)
    shutil.rmtree(own, ignore_errors=True)
    own.mkdir(parents=True)
    for file_name, data in inputs.items():
        (own / file_name).write_bytes(data)
    words = f"{len(inputs)} inputs, {sum(map(len, inputs.values()))} bytes"
    if too_long:
        words += f"; left out, being longer than {LARGEST} bytes: {', '.join(too_long)}"
    return words


def _merge(name: str, target: Path, sources: list[Path], places: Places) -> None:
    """Add to a folder the inputs of others that reach more than what is in it."""
    options = ("-merge=1", "-close_fd_mask=3", f"-max_len={targets.load(name).most}")
    folders = map(str, (target, *sources))
    _run(name, "--fuzz", str(places.findings), *options, *folders, places=places, timeout=1e6)
