"""Play campaigns on a simulated cell with everything that goes wrong, and judge them by laws."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path

from hil.progress import reporter
from tests.arguments import at_least_one, parser_of, whole_number
from tests.simulate.many import Known, played, stage_folder
from tests.simulate.script import GRAMMAR
from tests.simulate.verdicts import Stage, Verdict, judged, runs_of, summary
from tests.simulate.world import UndisturbedError

EPILOG = f"""\
One seed is one arm, plan, person and script of faults, and always the same run:
  python -m tests.simulate --seed 17                    play it and tell all of it
  python -m tests.simulate --seed 17 --script FILE      the same arm and plan, another script
  python -m tests.simulate --seeds 10000 --jobs 2 --journal seeds.jsonl
The last may be killed and typed again: what the journal knows is not played again. A journal
belongs to one state of the code; after a change of it name another.
The exit code is 1 if a law was broken. A script has lines of `hil simulate`'s faults, and of

{GRAMMAR}
"""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of("tests.simulate", __doc__, EPILOG)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--seed", type=whole_number, metavar="S", help="play this one and tell all of it"
    )
    what.add_argument("--seeds", type=whole_number, metavar="N", help="play N of them")
    option = parser.add_argument
    option("--start", type=whole_number, default=0, help="the first of N (0)")
    option("--script", type=Path, metavar="FILE", help="of --seed: instead of its own")
    option("--jobs", type=at_least_one, default=1, help="child processes (1)")
    option("--journal", type=Path, metavar="FILE", help="JSON lines, one a seed")
    option("--no-shrink", action="store_true", help="leave scripts of failures as is")
    option("--json", action="store_true", help="end with one JSON object")
    options = parser.parse_args(arguments)
    if options.seed is None and options.script is not None:
        parser.error("--script is played with one --seed, not with --seeds")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the children
    try:
        return _one(options) if options.seed is not None else _many(options)
    except ValueError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("stopped; what a journal has is kept\n")
        return 130


def _one(options: argparse.Namespace) -> int:
    script = None
    if options.script is not None:
        try:
            script = options.script.read_text("utf-8").splitlines()
        except OSError as error:
            raise ValueError(f"{options.script}: {error.strerror}; name a script") from error
    with stage_folder() as root:
        stage = Stage(root)
        try:
            seen = stage.observed(options.seed, script)
        except UndisturbedError as error:
            sys.stdout.write(f"BROKEN undisturbed: {error}\n")
            return 1
        broken, runs = judged(seen), runs_of(seen)
        lines = [f"seed {options.seed}: {stage.twin(options.seed).scene.words}"]
    if options.json:
        found = {
            "ran": 1,
            "failed": int(bool(broken)),
            "seeds_failed": [options.seed] if broken else [],
            "script": list(seen.schedule),
            "struck": list(seen.struck),
            "runs": list(runs),
            "broken": [list(one) for one in broken],
        }
        sys.stdout.write(json.dumps(found) + "\n")
        return int(bool(broken))
    lines += [
        f"  {line}{'' if line in seen.struck else '   (never struck)'}" for line in seen.schedule
    ]
    for number, (life, how) in enumerate(zip(seen.runs, runs, strict=True), start=1):
        why = "" if life.error is None else f": {life.error}"
        archives = ", ".join(life.archives) or "no archive"
        cycles = f"{life.first_cycle}..{life.last_cycle}"
        lines.append(f"run {number}, cycles {cycles}: {how}{why} [{archives}]")
    if seen.unidentified:
        lines.append(f"not identified: {seen.unidentified}")
    lines += [f"BROKEN {law}: {text}" for law, text in broken] or ["all laws hold"]
    sys.stdout.writelines(f"{line}\n" for line in lines)
    return int(bool(broken))


def _many(options: argparse.Namespace) -> int:
    known = Known(options.journal)
    seeds = range(options.start, options.start + options.seeds)
    verdicts: list[Verdict] = []
    failed = 0
    with redirect_stdout(sys.stderr if options.json else sys.stdout):
        progress = reporter()
        with progress.task("playing seeds", len(seeds)) as task:
            for verdict in played(seeds, known, options.jobs, shrink=not options.no_shrink):
                verdicts.append(verdict)
                failed += bool(verdict.broken)
                task.advance(1, f"{failed} failed")
                if verdict.broken:
                    progress.say(_failure(verdict))
    found = summary(verdicts)
    if options.json:
        sys.stdout.write(json.dumps(found) + "\n")
    else:
        sys.stdout.writelines(f"{name}: {value}\n" for name, value in found.items())
    return int(bool(failed))


def _failure(verdict: Verdict) -> str:
    lines = [f"FAILED seed {verdict.seed} ({verdict.scene})"]
    lines += [f"  {law}: {text}" for law, text in verdict.broken[:6]]
    lines += ["  script, made small:", *(f"    {line}" for line in verdict.shrunk)]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
