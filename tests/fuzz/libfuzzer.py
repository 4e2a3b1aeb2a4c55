"""Processes of libFuzzer: how one is run, how it ended, and which causes of failure it found."""

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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.journal import Journal, entries

ROOT = Path(__file__).resolve().parents[2]
CORPORA = Path(__file__).parent / "corpora"
OURS = ("hil", "drivers", "planner", "identification", "sim_fixtures")
INPUT, TRACEBACK = "input", "traceback.txt"
_STATUS = re.compile(
    r"^#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+) corp: (\d+)/\S+.*? rss: (\d+)Mb", re.MULTILINE
)
_TOTAL = re.compile(r"^(?:stat::number_of_executed_units:\s+|#)(\d+)", re.MULTILINE)
_PLACE = re.compile(r'File "([^"]+)", line (\d+)')
_ENDINGS = {"crash": "crash", "timeout": "timeout", "oom": "memory", "slow": "whole"}
_END_TIMEOUT = 10.0  # s for libFuzzer to end on request
_GRACE = 240.0  # s beyond the time that a process was given, for its start on a loaded machine


@dataclass(frozen=True)
class Piece:
    """One fuzzing process, a line of the journal; figures of libFuzzer are those at its end."""

    target: str
    seconds: float
    inputs: int  # executed
    edges: int  # covered
    features: int  # an edge executed more often is another feature
    corpus: int  # inputs
    memory: int  # resident [MB]
    ended: str = "whole"  # "stopped" by the user; or "crash", "timeout", "memory", "killed"
    reproduced: bool = False  # whether what ended it early ends the target again


def append(path: Path, piece: Piece) -> None:
    """Add a piece; it survives the death of this process and of the computer."""
    with Journal(path) as journal:
        journal.add(**asdict(piece))


def pieces(path: Path) -> list[Piece]:
    """Return all pieces of a journal; JournalError if it cannot be read."""
    return entries(path, lambda line: Piece(**line), "piece of fuzzing")


def signature(error: BaseException) -> str:
    """Return a name of the cause: the kind of error and the last line of the product.

    Of a RecursionError it is the first line, since the last is arbitrary.
    """
    frames = traceback.extract_tb(error.__traceback__)
    places = _places([(one.filename, str(one.lineno)) for one in frames])
    own = [place for place in places if place.split("/")[0] in OURS] or places or ["nowhere"]
    return _cause(type(error).__name__, own[0 if isinstance(error, RecursionError) else -1])


def _cause(kind: str, place: str) -> str:
    return f"{kind}-{place.replace('/', '.')}".replace(":", "-")


def _places(frames: list[tuple[str, str]]) -> list[str]:
    """Return ``file:line`` of the frames within this project."""
    return [
        f"{Path(name).relative_to(ROOT)}:{line}"
        for name, line in frames
        if Path(name).is_relative_to(ROOT) and ".venv" not in Path(name).parts
    ]


def record_finding(findings: Path, cause: str, data: bytes, text: str) -> bool:
    """Store an input that violated a law, one of each cause; return whether the cause is new."""
    folder = findings / cause
    if folder.exists():
        return False
    folder.mkdir(parents=True)
    (folder / INPUT).write_bytes(data)
    (folder / TRACEBACK).write_text(text[-20_000:], "utf-8", errors="backslashreplace")
    return True


@dataclass(frozen=True)
class Places:
    corpus: Path  # all inputs so far, outside of the repository
    findings: Path  # a folder per cause
    scratch: Path  # for artefacts of libFuzzer and temporary files; in memory if possible


@contextmanager
def places_of(journal: Path, target: str) -> Iterator[Places]:
    """Create the folders of a target beside its journal, and a temporary one."""
    own = Path(f"{journal}.files") / target
    for name in ("corpus", "findings"):
        (own / name).mkdir(parents=True, exist_ok=True)
    base = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    with tempfile.TemporaryDirectory(prefix="fuzz", dir=base, ignore_cleanup_errors=True) as made:
        yield Places(own / "corpus", own / "findings", Path(made))


def add_inputs(folder: Path, inputs: list[bytes]) -> None:
    """Write inputs under their digests, as libFuzzer names them."""
    for data in inputs:
        (folder / hashlib.sha1(data, usedforsecurity=False).hexdigest()).write_bytes(data)


def fuzz(target: str, seconds: float, most: int, places: Places, ended: threading.Event) -> Piece:
    """Fuzz a target in its own process for some time, or until that or `ended` ends it."""
    begun = time.monotonic()
    log = places.scratch / "log"
    with log.open("wb") as stream:
        process = _start(
            target, "--fuzz", str(places.findings), f"-max_total_time={max(1, round(seconds))}",
            f"-max_len={most}", "-print_final_stats=1", f"-artifact_prefix={places.scratch}/",
            "-reload=0", "-close_fd_mask=3", str(places.corpus), str(CORPORA / target),
            places=places, stdout=stream,
        )  # fmt: skip
        stopped = _wait(process, seconds + _GRACE, ended)
    text = log.read_text("utf-8", errors="replace")
    status = _STATUS.findall(text)
    _, edges, features, corpus, memory = map(int, status[-1]) if status else (0,) * 5
    inputs = int((_TOTAL.findall(text) or ["0"])[-1])
    how, reproduced = "stopped" if stopped else "whole", False
    if process.returncode and not stopped:
        how, reproduced = _early_end(target, process.returncode, text, places)
        if process.returncode > 0 and not inputs and not reproduced:
            raise RuntimeError(f"{target} cannot be fuzzed:\n{text[-3000:]}")
    lasted = round(time.monotonic() - begun, 1)
    return Piece(target, lasted, inputs, edges, features, corpus, memory, how, reproduced)


def _start(target: str, *arguments: str, places: Places, stdout: Any) -> subprocess.Popen[str]:
    """Start a process with one thread for linear algebra and temporary files in the scratch."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    environment = {"TMPDIR": str(places.scratch), "PYTHONHASHSEED": "0"}
    return subprocess.Popen(
        [sys.executable, "-m", "tests.fuzz.child", target, *arguments], cwd=ROOT,
        env={**os.environ, **threads, **environment}, text=True, errors="replace",
        start_new_session=True, stdout=stdout, stderr=subprocess.STDOUT,
    )  # fmt: skip


def _kill(process: subprocess.Popen[str]) -> None:
    if process.poll() is None:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def _wait(process: subprocess.Popen[str], seconds: float, ended: threading.Event) -> bool:
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
                process.wait(_END_TIMEOUT)
    finally:
        _kill(process)
    return stopped


def _early_end(target: str, status: int, text: str, places: Places) -> tuple[str, bool]:
    """Return how a process ended early, and whether its last input repeats that; store both."""
    found = sorted(places.scratch.glob("*-*"), key=lambda path: path.stat().st_mtime)
    artefacts = [path for path in found if path.name.split("-")[0] in _ENDINGS]
    if not artefacts:
        return "killed" if status < 0 else "crash", False
    last = artefacts[-1]
    ended, data = _ENDINGS[last.name.split("-")[0]], last.read_bytes()
    process = _start(target, "--once", str(last), places=places, stdout=subprocess.PIPE)
    try:
        output, _ = process.communicate(timeout=_GRACE)
    except subprocess.TimeoutExpired:
        output = f"did not end within {_GRACE:g} s"
    finally:
        _kill(process)
    if process.returncode:
        places_in_text = _places(_PLACE.findall(output)) or ["nowhere"]
        # faulthandler begins with the innermost line, Python ends with it.
        innermost = places_in_text[-1 if "Traceback (most recent call last)" in output else 0]
        code = process.returncode
        kind = signal.Signals(-code).name if code < 0 else ended
        record_finding(places.findings, _cause(kind, innermost), data, output)
    else:
        lost = places.findings.parent / "not_reproduced"
        lost.mkdir(exist_ok=True)
        shutil.copy(last, lost / last.name)
        (lost / "last.log").write_text(text[-10_000:], "utf-8")
    return ended, process.returncode != 0
