"""Run the whole real path for hours and watch what it takes: `python -m tests.endurance`.

A simulated controller sends a packet each millisecond over UDP on this computer. The product's own
exchange and archive process answer and record, and campaigns of short motions run on one link one
after another, about 26 archives in half a minute. Every 5 s memory, descriptors, threads and
processor time of each process and the exchange's own histogram of its latencies go to the journal;
each archive is checked, and removed when three newer campaigns are there. Campaigns whose archives
are not whole stay.

Each call is a piece with processes of its own and appends to the journal; --merge only prints what
all pieces together have shown. Ctrl-C or SIGTERM ends a piece properly, SIGKILL costs the last 5 s.
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
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hil.campaign import stop_on_interrupt
from hil.progress import reporter
from tests.arguments import time_above_0
from tests.endurance.journal import Piece, read_journal
from tests.endurance.piece import run_piece
from tests.endurance.verdict import SHARES, Verdict, judge
from tests.journal import COMPRESSED, JournalError

LONGEST = 90.0
"""min of a piece."""


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
        facts = {"good": not verdict.faults, "faults": verdict.faults, "doubts": verdict.doubts}
        sys.stdout.write(json.dumps({**facts, **verdict.figures}) + "\n")
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


def _lines(verdict: Verdict) -> list[str]:
    figures: dict[str, Any] = verdict.figures
    archives, latency = figures["archives"], figures["latency"]
    lines = [
        f"{figures['minutes']:g} minutes in {figures['pieces']} pieces ({figures['killed']} killed)"
        f", {', '.join(figures['scheduling'])}",
        f"processor: {figures['processor_share']} of a core",
        f"campaigns: {archives['campaigns']} ({archives['complete']} complete, "
        f"{archives['given_up']} given up, {archives['restarts']} restarts), "
        f"{archives['motions']} motions, {archives['archives']} archives {archives['outcomes']}, "
        f"{archives['records']} records",
        f"exchange: {latency['answered']} answered, {latency['missed']} missed, "
        f"{latency['late']} late, longest {latency['worst_us']:.0f} µs",
        "",
        "memory        first MiB  last MiB   own memory, MiB/h (99 % interval)   resident, MiB/h",
    ]
    for name, one in figures["memory"].items():
        growth = one["growth"]
        lines.append(
            f"{name:12} {one['first']:10.1f} {one['last']:9.1f} {growth['value']:9.3f}  "
            f"({growth['low']:.3f} to {growth['high']:.3f}) {one['rss_growth']['value']:12.3f}"
        )
    lines += [
        f"the supervisor holds {one['first']:.0f} {name}, per hour {one['value']:.0f} more "
        f"({one['low']:.0f} to {one['high']:.0f})"
        for name, one in figures["held"].items()
    ]
    lines += ["", f"descriptors, most in each half: {figures['descriptors']}", ""]
    lines.append("latency, µs   first minute   last   least   median   most   rise of others")
    for number, piece in enumerate(latency["pieces"], 1):
        for name in SHARES:
            one = piece[name]
            lines.append(
                f"{number:3} {name:8} {one['first_us']:13.0f} {one['last_us']:6.0f} "
                f"{one['least_us']:7.0f} {one['median_us']:8.0f} {one['most_us']:6.0f} "
                f"{one['rise_of_others'] - 1.0:12.0%}"
            )
    lines += ["", "blocks of 10 minutes, µs (load)   first          last"]
    for number, piece in enumerate(latency["pieces"], 1):
        for name in SHARES:
            one = piece[name]
            lines.append(
                f"{number:3} {name:8} {one['first_block_us']:19.0f} "
                f"({one['first_block_load']:.1f}) {one['last_block_us']:8.0f} "
                f"({one['last_block_load']:.1f})"
            )
    lines += ["", *(f"doubt: {text}" for text in verdict.doubts)]
    lines += [f"WRONG: {text}" for text in verdict.faults] or ["nothing is wrong"]
    return lines


if __name__ == "__main__":
    sys.exit(main())
