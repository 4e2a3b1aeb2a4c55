"""Run the whole real path for hours and measure it: `python -m tests.endurance`.

A simulated controller sends a packet each millisecond over UDP on this computer, and campaigns of
short motions run on one link, about 26 archives in half a minute. Every 5 s memory and threads of
each process and the histogram of latencies go to the journal; each archive is checked, and removed
when there are three newer campaigns. Campaigns with incomplete archives remain.

Each call is a piece and appends to the journal; --merge prints the verdict over all pieces of the
journals given. Ctrl-C or SIGTERM end a piece, SIGKILL costs the last 5 s.
Four hours in three pieces:

    for piece in 1 2 3; do
        python -m tests.endurance --minutes 80 --journal long.jsonl --folder /tmp/long
    done
    python -m tests.endurance --merge --journal long.jsonl

Exit status 1 for any fault, 2 if the journal is not one of these. Figures of a run that is too
short are warnings, and so is what the computer explains: slower replies at a higher load, campaigns
abandoned and replies missed while its cores stalled (measured by a process on each core). More than
one reply in 10 000 beyond that is a fault, and in any case half of a piece's campaigns or 1 % of
its replies.
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
from tests.arguments import parser_of, time_above_0
from tests.endurance.piece import run_piece
from tests.endurance.verdict import Piece, Verdict, judge, read_journal
from tests.journal import JournalError

LONGEST = 90.0  # min of a piece


def main(arguments: list[str] | None = None) -> int:
    """Run a piece, or only merge; print the verdict over all pieces."""
    parser = parser_of("tests.endurance", __doc__)
    option = parser.add_argument
    option("--journal", type=Path, required=True, nargs="+", help="JSON lines; appended to")
    option("--minutes", type=time_above_0, help="how long this piece takes, 90 at most")
    option("--folder", type=Path, help="where campaigns are made")
    option("--rate", type=int, choices=(500, 1000), default=1000, help="packets per second")
    option("--merge", action="store_true", help="run nothing, print the verdict")
    option("--json", action="store_true", help="print one line of JSON")
    given = parser.parse_args(arguments)
    try:
        pieces = _read(given.journal)  # before anything is appended to what is none
        if not given.merge:
            _run(given, parser)
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
        sys.stdout.write(json.dumps({"good": not verdict.faults, **asdict(verdict)}) + "\n")
    else:
        sys.stdout.writelines(f"{line}\n" for line in _lines(verdict))
    return 1 if verdict.faults else 0


def _read(journals: Sequence[Path]) -> list[Piece]:
    return [piece for path in journals for piece in read_journal(path)]


def _run(given: argparse.Namespace, parser: argparse.ArgumentParser) -> None:
    if given.folder is None or given.minutes is None:
        parser.error("--minutes and --folder are needed to run a piece")
    if given.minutes > LONGEST:
        parser.error(f"--minutes must be at most {LONGEST:g}")
    if len(given.journal) > 1:
        parser.error("a piece is appended to one --journal")
    with stop_on_interrupt() as stop:
        tell = reporter(quiet=given.json)
        run_piece(given.folder, given.journal[0], 60.0 * given.minutes, given.rate, stop, tell)


def _lines(verdict: Verdict) -> Iterator[str]:
    for number, piece in enumerate(verdict.figures, 1):
        yield f"piece {number}"
        for name, value in piece.items():
            yield f"  {name:40} {value}"
    yield from (f"warning: {text}" for text in verdict.warnings)
    yield from [f"WRONG: {text}" for text in verdict.faults] or ["nothing is wrong"]


if __name__ == "__main__":
    sys.exit(main())
