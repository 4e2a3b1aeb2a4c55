"""Coverage-guided fuzzing of all that reads foreign content: ``python -m tests.fuzz all``.

Targets: `codec` (packets, CAN frames), `session` (any conversation of a controller), `cell_file`,
`archive`, `importers`, `urdf`, `documents` (plans, settings, results). Needs atheris, which the
extra ``fuzz`` brings. The command resumes where an earlier one with the same journal ended, also
after a kill, until each target has been fuzzed for --minutes.

Beside the journal are FILE.files/TARGET/corpus and findings; a finding is a folder with the input
and the traceback. ``python -m tests.fuzz.child TARGET --once INPUT`` repeats it. Reported as
"not reproduced" are processes that ended early and whose last input alone does not repeat that.

Examples:
  python -m tests.fuzz session --minutes 5 --journal runs/fuzz.jsonl
  nice python -m tests.fuzz all --minutes 60 --jobs 2 --stop-after 85 --journal runs/fuzz.jsonl
"""

from __future__ import annotations

import json
import signal
import sys
import threading
import time
from pathlib import Path
from typing import Any

from hil.progress import Reporter, Task, reporter
from tests.arguments import at_least_one, parser_of, time_above_0
from tests.fuzz import libfuzzer, targets
from tests.journal import JournalError

PIECE = 120.0  # s of one process
LEAST = 5.0  # s below which no process is started


def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit status is 1 if anything was found, 2 without a journal."""
    parser = parser_of("tests.fuzz", __doc__)
    option = parser.add_argument
    option("target", choices=(*targets.NAMES, "all"))
    option("--minutes", type=time_above_0, default=1.0, help="of each target, in all pieces")
    option("--stop-after", type=time_above_0, metavar="MIN", help="end this command after that")
    option("--jobs", type=at_least_one, default=1, help="targets at a time")
    option("--journal", type=Path, required=True, help="JSON lines, added to")
    option("--json", action="store_true", help="print the figures as JSON")
    given = parser.parse_args(arguments)
    names = targets.NAMES if given.target == "all" else (given.target,)
    progress = reporter(quiet=given.json)
    until = time.monotonic() + 60.0 * (given.stop_after or 1e6)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    try:
        Run(names, 60.0 * given.minutes, until, given.journal).work(given.jobs, progress)
    except KeyboardInterrupt:
        progress.say("stopped; the same command continues from here")
    except JournalError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    report = reported(names, given.journal)
    sys.stdout.write(json.dumps(report) + "\n" if given.json else table(report))
    return int(bool(report["findings"] or report["not_reproduced"]))


class Run:
    """Fuzzes targets in pieces, the one that was fuzzed least first."""

    def __init__(self, names: tuple[str, ...], wanted: float, until: float, path: Path) -> None:
        self._wanted, self._until, self._path = wanted, until, path
        self._done = dict.fromkeys(names, 0.0)
        for piece in libfuzzer.pieces(path):
            if piece.target in self._done:
                self._done[piece.target] += piece.seconds
        self._busy: set[str] = set()
        self._lock, self._ended = threading.Lock(), threading.Event()
        self._failed: list[BaseException] = []

    def work(self, jobs: int, progress: Reporter) -> None:
        """Work until all have their time; RuntimeError if a target cannot be fuzzed at all."""
        left = sum(max(0.0, self._wanted - done) for done in self._done.values())
        with progress.task("fuzzing", left) as task:
            workers = [threading.Thread(target=self._worker, args=(task,)) for _ in range(jobs)]
            try:
                for worker in workers:
                    worker.start()
                while any(worker.is_alive() for worker in workers):
                    time.sleep(0.2)
            finally:
                self._ended.set()
                for worker in workers:  # each ends its process and adds it to the journal
                    if worker.ident is not None:
                        worker.join()
        if self._failed:
            raise self._failed[0]

    def _worker(self, task: Task) -> None:
        try:
            while (given := self._next()) is not None:
                name, seconds = given
                target = targets.load(name)
                with libfuzzer.places_of(self._path, name) as places:
                    if not any(places.corpus.iterdir()):
                        libfuzzer.add_inputs(places.corpus, target.seeds())
                    piece = libfuzzer.fuzz(name, seconds, target.most, places, self._ended)
                with self._lock:
                    libfuzzer.append(self._path, piece)
                    self._done[name] += piece.seconds
                    self._busy.discard(name)
                    note = f"{name}: {piece.inputs} inputs, {piece.features} features"
                    task.advance(min(piece.seconds, seconds), note)
        except BaseException as error:
            self._failed.append(error)
            self._ended.set()

    def _next(self) -> tuple[str, float] | None:
        with self._lock:
            free = [name for name in self._done if name not in self._busy]
            if not free or self._ended.is_set():
                return None
            name = min(free, key=lambda one: self._done[one])
            left = min(self._wanted - self._done[name], self._until - time.monotonic())
            if left < LEAST:
                return None
            self._busy.add(name)
            return name, min(left, PIECE)


def reported(names: tuple[str, ...], path: Path) -> dict[str, Any]:
    """Return the figures of all pieces: sums, the largest coverage, and the causes found."""
    done = libfuzzer.pieces(path)
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        own = [piece for piece in done if piece.target == name]
        early = [one for one in own if one.ended not in ("whole", "stopped")]
        findings = Path(f"{path}.files") / name / "findings"
        found[name] = {
            "inputs": sum(piece.inputs for piece in own),
            "seconds": round(sum(piece.seconds for piece in own), 1),
            "edges": max((piece.edges for piece in own), default=0),
            "features": max((piece.features for piece in own), default=0),
            "not_reproduced": sum(not piece.reproduced for piece in early),
            "findings": sorted(one.name for one in findings.glob("*")),
        }
    return {
        "inputs": sum(target["inputs"] for target in found.values()),
        "seconds": round(sum(target["seconds"] for target in found.values()), 1),
        "findings": sum(len(target["findings"]) for target in found.values()),
        "not_reproduced": sum(target["not_reproduced"] for target in found.values()),
        "targets": found,
    }


def table(report: dict[str, Any]) -> str:
    """Return the figures as text, a line per target and per cause."""
    heads = ("inputs", "seconds", "edges", "features", "not_reproduced")
    lines = [f"{'target':>10} " + " ".join(f"{head:>14}" for head in heads)]
    for name, target in report["targets"].items():
        lines.append(f"{name:>10} " + " ".join(f"{target[head]:>14,}" for head in heads))
        lines += [f"{'finding':>10}   {cause}" for cause in target["findings"]]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
