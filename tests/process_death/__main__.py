"""Kill the processes of a real campaign at random moments: `python -m tests.process_death`.

Each round runs a short campaign over real sockets, of a C4G or with `--link rtde` of a UR, kills
one to three of its processes by SIGKILL, and checks that the arm came to rest, open mode was left,
every recording is readable, and the next run completes the campaign. The number of a round is its
seed.

    python -m tests.process_death --rounds 1000 --jobs 2 --journal deaths.jsonl
    python -m tests.process_death --rounds 1 --start 417      # this one again
    python -m tests.process_death --rounds 1 --start 417 --script FILE    # other kills

Rounds in the journal are not run again, so that an interrupted command may be repeated. Exit status
1 if a law was broken (the folders of such rounds remain), 2 if the journal is not one of these. A
script has lines of `tests.faults.STRIKES`; without one, a round draws its own.
"""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any, get_args

# Before numpy is imported: the machine is small.
for _variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

from tests.arguments import at_least_one, parser_of, whole_number  # noqa: E402
from tests.faults import Strikes, parse_strikes  # noqa: E402
from tests.journal import Journal, JournalError, rounds  # noqa: E402
from tests.process_death.laws import PROMISED  # noqa: E402
from tests.process_death.page import die_with_parent  # noqa: E402
from tests.process_death.play import DEFECTS, Stage, planted, play  # noqa: E402  # noqa: E402
from tests.process_death.rounds import VICTIMS, LinkName, round_of  # noqa: E402

_stage: Stage | None = None  # What rounds share; their processes are forked from one that has it


def main(arguments: Sequence[str] | None = None) -> int:
    """Run rounds, or what is missing of them."""
    parser = parser_of("tests.process_death", __doc__)
    option = parser.add_argument
    option("--rounds", type=whole_number, default=50, help="how many (50)")
    option("--start", type=whole_number, default=0, help="number of the first (0)")
    option("--link", choices=get_args(LinkName), default="udp", help="of the campaign (udp)")
    option("--jobs", type=at_least_one, default=1, help="rounds at a time (1)")
    option("--only", choices=VICTIMS, help="those rounds in which this process dies first")
    option("--script", type=Path, metavar="FILE", help="script in place of those of the rounds")
    option("--journal", type=Path, help="JSON lines with the results; resumed if it exists")
    option("--json", action="store_true", help="print nothing but one JSON object")
    option("--defect", choices=sorted(DEFECTS), help="break the product, to see that it is found")
    given = parser.parse_args(arguments)
    # Also where a shell has started this in the background, and ignores SIGINT.
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        strikes = None if given.script is None else script_of(given.script)
        recorded = rounds(given.journal, "link", "broken", "seconds", "processor")
        journal = Journal(given.journal)
    except (JournalError, ValueError) as error:
        sys.stderr.write(f"error: {error}\n")
        return 2
    numbers = range(given.start, given.start + given.rounds)
    wanted = [n for n in numbers if given.only in (None, round_of(n).strikes.victims[0])]
    if other := {result["link"] for result in recorded.values()} - {given.link}:
        sys.stderr.write(f"error: {given.journal} is of {other.pop()}; name another --journal\n")
        return 2
    results = [recorded[n] for n in wanted if n in recorded]
    missing = [n for n in wanted if n not in recorded]
    began = time.monotonic()
    folder = Path(tempfile.mkdtemp(prefix="process_death_"))
    interrupted = False
    try:
        with journal:
            for result in _played(missing, given.link, given.jobs, folder, given.defect, strikes):
                results.append(result)
                journal.add(**result)
                _print(result, len(results), len(wanted), folder, quiet=given.json)
    except KeyboardInterrupt:
        interrupted = True
        sys.stderr.write("interrupted; with --journal the same command resumes\n")
    finally:
        folders = sorted(str(path) for path in folder.glob("round_*"))
        if not folders:
            shutil.rmtree(folder)
    report = summary(results) | {"wall_seconds": time.monotonic() - began, "kept": folders}
    if given.json:
        sys.stdout.write(json.dumps(report) + "\n")
    else:
        sys.stdout.writelines(f"{name:>16} {value}\n" for name, value in report.items())
    return 130 if interrupted else 1 if report["failed"] else 0


def script_of(path: Path) -> Strikes:
    """Read a script; ValueError if that fails."""
    try:
        return parse_strikes(path.read_text("utf-8").splitlines())
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}; name a script") from error


def _played(
    numbers: Sequence[int],
    link: LinkName,
    jobs: int,
    folder: Path,
    defect: str | None,
    strikes: Strikes | None,
) -> Iterator[dict[str, Any]]:
    global _stage
    if not numbers:
        return
    if sys.dont_write_bytecode:  # else each process compiles everything
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = str(folder / "compiled")
    _stage = Stage.set_up(folder, link, None if defect is None else planted(defect, folder))
    context = multiprocessing.get_context("fork")
    with ProcessPoolExecutor(jobs, mp_context=context, initializer=die_with_parent) as pool:
        try:
            for future in as_completed([pool.submit(_play, number, strikes) for number in numbers]):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)


def _play(number: int, strikes: Strikes | None) -> dict[str, Any]:
    if _stage is None:
        raise RuntimeError("this process was not forked from one that has set the stage")
    return play(_stage, number, strikes)


def _print(result: dict[str, Any], done: int, of: int, folder: Path, *, quiet: bool) -> None:
    """Print a line for each round, and what was broken with the command that repeats it."""
    broken = result["broken"]
    if broken:
        lines = [
            f"BROKEN {result['what']}",
            *(f"  {text}" for text in broken),
            f"  again: python -m tests.process_death --link {result['link']} --rounds 1"
            f" --start {result['round']}",
            f"  kept: {folder}/round_{result['round']:05d}",
        ]
        sys.stderr.write("\n".join(lines) + "\n")
    elif not quiet:
        sys.stderr.write(f"{done}/{of} {result['what']}: {result['seconds']:.1f} s\n")


def summary(results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    failed = sorted(result["round"] for result in results if result["broken"])
    lost = sorted(result["lost"] for result in results if "lost" in result)
    return {
        "ran": len(results),
        "failed": len(failed),
        "seeds_failed": failed,
        "killed": dict(
            Counter(victim for result in results for victim in result.get("killed", ()))
        ),
        "nobody_killed": sum(not result.get("killed") for result in results),
        "archives_torn": len(lost),
        "lost_at_most": lost[-1] if lost else 0,
        "lost_within_promise": sum(count <= PROMISED for count in lost),
        "seconds": sum(result["seconds"] for result in results),
        "processor_seconds": sum(result["processor"] for result in results),
    }


if __name__ == "__main__":
    sys.exit(main())
