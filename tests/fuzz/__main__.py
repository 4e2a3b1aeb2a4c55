"""Coverage-guided fuzzing of all that reads what others wrote: ``python -m tests.fuzz all``.

Targets: `codec` (packets, CAN frames), `session` (a controller that does anything), `cell_file`,
`archive`, `importers`, `urdf`, `documents` (plans, settings, results). Needs atheris, which the
extra ``fuzz`` brings. The command resumes where an earlier one with the same journal ended, also
after a kill, until each target has been fuzzed for --minutes.

Beside the journal lie FILE.files/TARGET/corpus and findings; a finding is a folder with the input,
its shortest form and the traceback. ``python -m tests.fuzz.child TARGET --once INPUT`` repeats it.
Reported as deaths are processes that ended early and whose last input alone does not repeat that.

Examples:
  python -m tests.fuzz session --minutes 5 --journal runs/fuzz.jsonl
  nice python -m tests.fuzz all --minutes 60 --jobs 2 --stop-after 85 --journal runs/fuzz.jsonl
  python -m tests.fuzz all --keep --journal runs/fuzz.jsonl    the best inputs to the repository
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
from tests.fuzz import lives, targets
from tests.journal import JournalError

PIECE = 120.0  # s: what a kill loses of the figures, never of the inputs
LEAST = 5.0  # s that are worth a start


def main(arguments: list[str] | None = None) -> int:
    """Run the command; the exit status is 1 if anything was found, or died, 2 without a journal."""
    parser = parser_of("tests.fuzz", __doc__)
    option = parser.add_argument
    option("target", choices=(*targets.NAMES, "all"))
    option("--minutes", type=time_above_0, default=1.0, help="of each target, in all pieces")
    option("--stop-after", type=time_above_0, metavar="MIN", help="end this piece after that")
    option("--jobs", type=at_least_one, default=1, help="targets at a time")
    option("--journal", type=Path, required=True, help="JSON lines, added to")
    option("--json", action="store_true", help="print the figures as JSON")
    option("--keep", action="store_true", help="choose the repository's corpora again")
    given = parser.parse_args(arguments)
    names = targets.NAMES if given.target == "all" else (given.target,)
    progress = reporter(quiet=given.json)
    if given.keep:
        for name in names:
            progress.say(f"{name}: {lives.keep(name, given.journal)}")
        return 0
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
    """Pieces of targets, the one that was fuzzed least before the others."""

    def __init__(self, names: tuple[str, ...], wanted: float, until: float, path: Path) -> None:
        self._wanted, self._until, self._path = wanted, until, path
        self._done = dict.fromkeys(names, 0.0)
        for piece in lives.pieces(path):
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
                for worker in workers:  # each ends its process and writes down what that did
                    if worker.ident is not None:
                        worker.join()
        if self._failed:
            raise self._failed[0]

    def _worker(self, task: Task) -> None:
        try:
            while (given := self._next()) is not None:
                name, seconds = given
                target = targets.load(name)
                with lives.beside(self._path, name) as places:
                    if not any(places.corpus.iterdir()):
                        lives.plant(places.corpus, target.seeds())
                    piece = lives.live(name, seconds, target.most, places, self._ended)
                    lives.shorten(name, places, self._ended)
                with self._lock:
                    lives.append(self._path, piece)
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
    """The figures of all pieces so far."""
    totals = lives.summary(path)
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        findings = lives.known(Path(f"{path}.files") / name / "findings")
        found[name] = {**totals.get(name, {}), "findings": findings}
    return {
        "inputs": sum(target.get("inputs", 0) for target in found.values()),
        "seconds": round(sum(target.get("seconds", 0.0) for target in found.values()), 1),
        "findings": sum(len(target["findings"]) for target in found.values()),
        "not_reproduced": sum(target.get("not_reproduced", 0) for target in found.values()),
        "targets": found,
    }


def table(report: dict[str, Any]) -> str:
    """The same for a person."""
    lines = [
        f"{'target':>10} {'inputs':>12} {'minutes':>8} {'edges':>7} {'features':>9} "
        f"{'findings':>8} deaths"
    ]
    for name, target in report["targets"].items():
        lines.append(
            f"{name:>10} {target.get('inputs', 0):>12,} {target.get('seconds', 0.0) / 60:>8.1f} "
            f"{target.get('edges', 0):>7,} {target.get('features', 0):>9,} "
            f"{len(target['findings']):>8} {target.get('not_reproduced', 0):>6}"
        )
        lines += [f"{'':>10} {count:>12,} × {cause}" for cause, count in target["findings"].items()]
    if report["not_reproduced"]:
        lines.append(
            f"deaths that one input does not repeat: {report['not_reproduced']}; "
            "see FILE.files/TARGET/not_reproduced"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
