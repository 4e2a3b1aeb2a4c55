"""Simulate campaigns with random faults of link, controller, PC and disk, and check their laws."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Sequence
from contextlib import redirect_stdout
from pathlib import Path

from hil.base.progress import reporter
from tests.arguments import at_least_one, parser_of, whole_number
from tests.faults import GRAMMAR
from tests.simulate.many import played, stage_folder
from tests.simulate.verdicts import Stage, Verdict, broken_by, runs_of, summary
from tests.simulate.world import UndisturbedError

EPILOG = f"""\
A seed determines arm, plan, operator and script of faults; runs are reproducible.
  python -m tests.simulate --seed 17                    run it and print the details
  python -m tests.simulate --seed 17 --script FILE      the same arm and plan, another script
  python -m tests.simulate --seeds 10000 --jobs 2 --journal seeds.jsonl
The last can be interrupted and repeated: seeds in the journal are not run again. Use another
journal for each version of the code.
The exit code is 1 if a law was broken. A script has lines of the faults of `hil simulate`, and of

{GRAMMAR}
"""


def main(arguments: Sequence[str] | None = None) -> int:
    parser = parser_of("tests.simulate", __doc__, EPILOG)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument(
        "--seed", type=whole_number, metavar="S", help="run one seed and print the details"
    )
    what.add_argument("--seeds", type=whole_number, metavar="N", help="run N seeds")
    option = parser.add_argument
    option("--start", type=whole_number, default=0, help="first of the N seeds (0)")
    option("--script", type=Path, metavar="FILE", help="script for --seed, in place of its own")
    option("--jobs", type=at_least_one, default=1, help="child processes (1)")
    option("--journal", type=Path, metavar="FILE", help="JSON lines, one per seed")
    option("--no-shrink", action="store_true", help="do not reduce scripts of failures")
    option("--json", action="store_true", help="print one JSON object at the end")
    options = parser.parse_args(arguments)
    if options.seed is None and options.script is not None:
        parser.error("--script needs --seed, not --seeds")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the children
    try:
        return _one(options) if options.seed is not None else _many(options)
    except ValueError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    except KeyboardInterrupt:
        sys.stderr.write("stopped; the journal is complete so far\n")
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
        broken = broken_by(seen)
        runs = runs_of(seen)
        lines = [f"seed {options.seed}: {stage.twin(options.seed).scene.words}"]
    if options.json:
        document = {
            "ran": 1,
            "failed": int(bool(broken)),
            "seeds_failed": [options.seed] if broken else [],
            "script": list(seen.schedule),
            "struck": list(seen.struck),
            "runs": list(runs),
            "broken": [list(violation) for violation in broken],
        }
        sys.stdout.write(json.dumps(document) + "\n")
        return int(bool(broken))
    lines += [
        f"  {line}{'' if line in seen.struck else '   (did not occur)'}" for line in seen.schedule
    ]
    for number, (life, how) in enumerate(zip(seen.runs, runs, strict=True), start=1):
        why = "" if life.error is None else f": {life.error}"
        archives = ", ".join(life.archives) or "no archive"
        cycles = f"{life.first_cycle}..{life.last_cycle}"
        lines.append(f"run {number}, cycles {cycles}: {how}{why} [{archives}]")
    if seen.unidentified:
        lines.append(f"not identified: {seen.unidentified}")
    lines += [f"BROKEN {law}: {text}" for law, text in broken] or ["no law is broken"]
    sys.stdout.writelines(f"{line}\n" for line in lines)
    return int(bool(broken))


def _many(options: argparse.Namespace) -> int:
    seeds = range(options.start, options.start + options.seeds)
    verdicts: list[Verdict] = []
    failed = 0
    shrink = not options.no_shrink
    with redirect_stdout(sys.stderr if options.json else sys.stdout):
        progress = reporter()
        with progress.task("simulating seeds", len(seeds)) as task:
            for verdict in played(seeds, options.journal, options.jobs, shrink=shrink):
                verdicts.append(verdict)
                failed += bool(verdict.broken)
                task.advance(1, f"{failed} failed")
                if verdict.broken:
                    progress.say(_failure(verdict))
    figures = summary(verdicts)
    if options.json:
        sys.stdout.write(json.dumps(figures) + "\n")
    else:
        sys.stdout.writelines(f"{name}: {value}\n" for name, value in figures.items())
    return int(bool(failed))


def _failure(verdict: Verdict) -> str:
    lines = [f"FAILED seed {verdict.seed} ({verdict.scene})"]
    lines += [f"  {law}: {text}" for law, text in verdict.broken[:6]]
    lines += ["  reduced script:", *(f"    {line}" for line in verdict.shrunk)]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
