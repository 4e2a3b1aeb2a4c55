"""Lives of fuzzing processes: started, watched, and understood when they end."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from tests.fuzz.findings import INPUT, ROOT, SHORTEST, Findings, named
from tests.fuzz.journal import Piece

CORPORA = Path(__file__).parent / "corpora"
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
class Places:
    """Where a target's inputs lie."""

    corpus: Path  # all that was kept so far, outside of the repository
    findings: Path  # a folder per cause
    scratch: Path  # for artefacts of libFuzzer and temporary files; lives in memory where it can

    @classmethod
    def beside(cls, journal: Path, target: str) -> Places:
        """Those that belong to a journal, made if they are not there."""
        own = Path(f"{journal}.files") / target
        shm = Path("/dev/shm")
        base = shm if shm.is_dir() and os.access(shm, os.W_OK) else None
        places = cls(own / "corpus", own / "findings", Path(tempfile.mkdtemp("fuzz", dir=base)))
        places.corpus.mkdir(parents=True, exist_ok=True)
        places.findings.mkdir(parents=True, exist_ok=True)
        return places


def live(target: str, seconds: float, most: int, places: Places, ended: threading.Event) -> Piece:
    """Fuzz a target in a process of its own for some time, or until that or `ended` ends it."""
    begun = time.monotonic()
    log = places.scratch / "log"
    options = [
        f"-max_total_time={max(1, round(seconds))}", f"-max_len={most}", "-print_final_stats=1",
        f"-artifact_prefix={places.scratch}/", "-reload=0", "-close_fd_mask=3", str(places.corpus),
        str(CORPORA / target),
    ]  # fmt: skip
    with log.open("wb") as stream:
        process = subprocess.Popen(
            [*command_of(target), "--fuzz", str(places.findings), *options],
            stdout=stream, stderr=stream, cwd=ROOT, env=environment_of(places),
            start_new_session=True,
        )  # fmt: skip
        stopped = _watched(process, seconds + _GRACE, ended)
    text = log.read_text("utf-8", errors="replace")
    pulses = _PULSE.findall(text)
    _, edges, features, corpus, memory = map(int, pulses[-1]) if pulses else (0,) * 5
    counted = _TOTAL.findall(text) or _OPEN.findall(text)
    inputs = int(counted[-1]) if counted else 0
    how, reproduced = "stopped" if stopped else "whole", False
    if process.returncode and not stopped:
        how, reproduced = _understood(target, process.returncode, text, places)
    if process.returncode > 0 and not inputs and not reproduced and not stopped:
        raise RuntimeError(f"{target} cannot be fuzzed:\n{text[-3000:]}")
    lasted = time.monotonic() - begun
    return Piece(target, round(lasted, 1), inputs, edges, features, corpus, memory, how, reproduced)


def _watched(process: subprocess.Popen[bytes], seconds: float, ended: threading.Event) -> bool:
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
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    return stopped


def _understood(target: str, status: int, text: str, places: Places) -> tuple[str, bool]:
    """How a process ended that did not end by itself; its input is tried again, and kept."""
    found = sorted(places.scratch.glob("*-*"), key=lambda path: path.stat().st_mtime)
    artefacts = [path for path in found if path.name.split("-")[0] in _ENDINGS]
    if not artefacts:
        return "killed" if status < 0 else "crash", False
    artefact = artefacts[-1]
    ended = _ENDINGS[artefact.name.split("-")[0]]
    data = artefact.read_bytes()
    for path in artefacts:
        path.unlink()
    again = places.scratch / "again"
    again.write_bytes(data)
    try:
        tried = subprocess.run(
            [*command_of(target), "--once", str(again)], capture_output=True, timeout=_GRACE,
            cwd=ROOT, env=environment_of(places), text=True, errors="replace", check=False,
        )  # fmt: skip
        status, story = tried.returncode, tried.stderr
    except subprocess.TimeoutExpired as hung:
        status, story = -signal.SIGKILL, f"did not end within {hung.timeout:g} s"
    reproduced = status != 0
    if reproduced:
        kind = signal.Signals(-status).name if status < 0 else ended
        Findings(places.findings).keep(named(kind, _innermost(story)), data, story[-20_000:])
    else:
        kept = places.findings.parent / "not_reproduced"
        kept.mkdir(exist_ok=True)
        (kept / f"{ended}-{len(list(kept.iterdir()))}").write_bytes(data)
        (kept / "last.log").write_text(text[-10_000:], "utf-8")
    return ended, reproduced


def _innermost(story: str) -> str:
    """The innermost line of ours in what faulthandler or Python wrote (a fault's comes first)."""
    ours = []
    for name, line in _PLACE.findall(story):
        path = Path(name)
        if path.is_relative_to(ROOT) and ".venv" not in path.parts:
            ours.append(f"{path.relative_to(ROOT)}:{line}")
    if not ours:
        return "nowhere"
    return ours[-1] if "Traceback (most recent call last)" in story else ours[0]


def shorten(target: str, places: Places, ended: threading.Event) -> None:
    """Make the shortest input of each finding that has none yet, unless `ended` is set."""
    for folder in sorted(places.findings.iterdir()):
        if ended.is_set():
            return
        if (folder / INPUT).exists() and not (folder / SHORTEST).exists():
            # A fault or a hang cannot be shortened from within; its input stays as it is.
            if not folder.name.startswith("SIG"):
                subprocess.run(
                    [*command_of(target), "--shorten", str(folder)], capture_output=True,
                    timeout=4 * _GRACE, cwd=ROOT, env=environment_of(places), check=False,
                )  # fmt: skip
            if not (folder / SHORTEST).exists():
                shutil.copy(folder / INPUT, folder / SHORTEST)


def command_of(target: str) -> list[str]:
    """What begins the command line of a target's process."""
    return [sys.executable, "-m", "tests.fuzz.child", target]


def environment_of(places: Places) -> dict[str, str]:
    """One thread for linear algebra, temporary files in the scratch folder."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    return {**os.environ, **threads, "TMPDIR": str(places.scratch), "PYTHONHASHSEED": "0"}
