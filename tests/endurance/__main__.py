"""Run the whole real path for hours and watch what it takes: `python -m tests.endurance`.

A simulated controller sends a packet each millisecond over UDP on this computer. The product's own
exchange and archive process answer and record, and campaigns of short motions run on one link one
after another, about 26 archives in half a minute. Every 5 s memory and threads of each process and
the exchange's own histogram of its latencies go to the journal; each archive is checked, and
removed when three newer campaigns are there. Campaigns whose archives are not whole stay.

Each call is a piece and appends to the journal; --merge only prints what each of them has shown.
Ctrl-C or SIGTERM ends a piece properly, SIGKILL costs the last 5 s.
Four hours in three pieces:

    for piece in 1 2 3; do
        python -m tests.endurance --minutes 80 --journal long.jsonl --folder /tmp/long
    done
    python -m tests.endurance --merge --journal long.jsonl

Merged are as many journals as are named, those compressed by `xz` (`long.jsonl.xz`) among them.

The exit code is 1 if anything is wrong, 0 if not, and 2 if the journal is none. What a run is too
short for is said as a doubt, and so is what the machine explains: slower answers while more was to
do, campaigns given up and answers missed while its cores stood still, which a process on each of
them tells that does nothing else. More than one answer in 10 000 beyond that is wrong. Two bounds
hold whatever stood still: half of a piece's campaigns, and 1 % of its answers.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path

from hil.campaign import stop_on_interrupt
from hil.progress import reporter
from tests.arguments import time_above_0
from tests.endurance.piece import run_piece
from tests.endurance.verdict import Piece, Verdict, judge, read_journal
from tests.journal import COMPRESSED, JournalError

LONGEST = 90.0  # min of a piece


def main(arguments: list[str] | None = None) -> int:
    """Run a piece, or only merge; print the verdict over all pieces."""
    given = _parser().parse_args(arguments)
    try:
        _read(given.journal)  # before anything is appended to what is none
        if not given.merge:
            _run(given)
        pieces = _read(given.journal)
    except JournalError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    if not pieces:
        names = ", ".join(map(str, given.journal))
        sys.stderr.write(f"error: no piece is in {names}; run one first\n")
        return 2
    verdict = judge(pieces)
    if given.json:
        facts = {"good": not verdict.faults, **asdict(verdict)}
        sys.stdout.write(json.dumps(facts) + "\n")
    else:
        sys.stdout.write("\n".join(_lines(verdict)) + "\n")
    return 1 if verdict.faults else 0


def _read(journals: Sequence[Path]) -> list[Piece]:
    return [piece for path in journals for piece in read_journal(path)]


def _run(given: argparse.Namespace) -> None:
    """Run a piece, and append to the journal."""
    if given.folder is None or given.minutes is None:
        _parser().error("--minutes and --folder are needed to run a piece")
    if given.minutes > LONGEST:
        _parser().error(f"--minutes must be at most {LONGEST:g}")
    if len(given.journal) > 1 or given.journal[0].suffix == COMPRESSED:
        _parser().error("a piece is appended to one --journal, and not to a compressed one")
    seconds = 60.0 * given.minutes
    with stop_on_interrupt() as stop:
        told = reporter(quiet=given.json)
        run_piece(given.folder, given.journal[0], seconds, given.rate, stop, told)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m tests.endurance",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--journal", type=Path, required=True, nargs="+", help="JSON lines; appended to"
    )
    parser.add_argument(
        "--minutes", type=time_above_0, help="how long this piece takes, 90 at most"
    )
    parser.add_argument("--folder", type=Path, help="where campaigns are made")
    parser.add_argument(
        "--rate", type=int, choices=(500, 1000), default=1000, help="packets per second"
    )
    parser.add_argument("--merge", action="store_true", help="run nothing, print the verdict")
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    return parser


def _lines(verdict: Verdict) -> Iterator[str]:
    for number, piece in enumerate(verdict.figures, 1):
        yield f"piece {number}"
        for name, value in piece.items():
            yield f"  {name:40} {value}"
    yield from (f"doubt: {text}" for text in verdict.doubts)
    yield from [f"WRONG: {text}" for text in verdict.faults] or ["nothing is wrong"]


if __name__ == "__main__":
    sys.exit(main())
