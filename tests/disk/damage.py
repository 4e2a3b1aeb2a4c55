"""Damage archives of a finished campaign, many times: `python -m tests.disk.damage --rounds 1000`.

Each round damages an archive or two as its number says (`tests/disk/harm.py`) and has everything
that reads archives read them: `hil archive check`, `hil.open_recording`, `hil plot`,
`hil identify` of archives or of the folder, every tenth round `hil reidentify` and `hil compare`.
Each must give a named error, or what it gave before, or say in words what was left out
(`tests/disk/laws.py`).

Rounds in the journal are not run again. A failure is printed with the command that repeats it. The
exit code is 1 if a law was broken in any round of the journal, 2 if the journal is none of these.
"""

from __future__ import annotations

import argparse
import json
import random
import sys
import tempfile
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hil.batch.workers import LocalWorkers, Workers
from hil.campaign import stop_on_interrupt
from hil.progress import reporter
from tests.arguments import whole_number
from tests.disk.harm import draw
from tests.disk.laws import Undamaged, broken, undamaged
from tests.hil.fast_cell import fast_campaign, fast_cell
from tests.journal import Journal, JournalError
from tests.journal import rounds as known

EVERY = 10  # Rounds of which one is pooled and compared as well
SEED = 20261120


def campaign(folder: Path, workers: Workers | None, repetitions: int = 3) -> Undamaged:
    """A campaign of some repetitions and one validation run, finished."""
    made = fast_campaign(folder / "campaign", fast_cell(folder, repetitions=repetitions))
    made.run(durable=False, unrehearsed=True)
    return undamaged(made.folder.root, workers)


def play(
    truth: Undamaged, number: int, workers: Workers | None, kind: str | None = None
) -> tuple[str, list[str]]:
    """One round: what was damaged, and the laws it broke. The files are whole again after it."""
    harm = draw(random.Random(f"{SEED}/{number}"), truth.files, kind)
    try:
        for path, data in harm.files.items():
            path.write_bytes(data)
        return harm.words, list(broken(truth, sorted(harm.files), number, workers))
    finally:
        for path in harm.files:
            path.write_bytes(truth.files[path])


def run(
    given: argparse.Namespace, before: Mapping[int, dict[str, Any]]
) -> dict[int, dict[str, Any]]:
    """The rounds that are asked for, without those that were run before."""
    rounds: dict[int, dict[str, Any]] = {}
    left = [n for n in range(given.start, given.start + given.rounds) if n not in before]
    if not left:
        return rounds
    tell = reporter(quiet=given.json)
    with (
        stop_on_interrupt() as stop,
        tempfile.TemporaryDirectory(dir=given.folder) as folder,
        LocalWorkers(1) as workers,
        Journal(given.journal) as journal,
        tell.task("damaging archives (rounds)", len(left)) as task,
    ):
        truth = campaign(Path(folder), workers)
        for number in left:
            if stop.requested:
                break
            pooled = workers if number % EVERY == 0 else None
            words, laws = play(truth, number, pooled)
            rounds[number] = {"round": number, "harm": words, "broken": laws}
            journal.add(**rounds[number])
            for law in laws:
                again = f"python -m tests.disk.damage --rounds 1 --start {number}"
                sys.stderr.write(f"round {number} ({words}): {law}\n  again: {again}\n")
            task.advance(1)
    return rounds


def main(arguments: list[str] | None = None) -> int:
    """Run rounds and print what came of all in the journal."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.disk.damage",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--rounds", type=whole_number, default=100)
    parser.add_argument(
        "--start", type=whole_number, default=0, help="number of the first round: its seed"
    )
    parser.add_argument("--journal", type=Path, help="JSON lines; rounds in it are not run again")
    parser.add_argument("--folder", type=Path, help="where a temporary folder is made")
    parser.add_argument("--json", action="store_true", help="print one line of JSON")
    given = parser.parse_args(arguments)
    try:
        rounds = known(given.journal, "harm", "broken")
        rounds |= run(given, rounds)
    except JournalError as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    failed = sorted(number for number, one in rounds.items() if one["broken"])
    kinds = Counter(str(one["harm"]).partition(" in ")[0] for one in rounds.values())
    facts = {"ran": len(rounds), "failed": len(failed), "seeds_failed": failed}
    if given.json:
        sys.stdout.write(json.dumps({"kinds": dict(kinds), **facts}) + "\n")
    else:
        sys.stdout.write(f"{len(rounds)} rounds, {len(failed)} failed {failed or ''}\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
