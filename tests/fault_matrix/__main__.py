"""Run every fault in every situation and print what came of it: `python -m tests.fault_matrix`.

The table is that of docs/fault-matrix.md; the exit code is 1 if a law was broken.
"""

from __future__ import annotations

import sys
from collections import Counter

from tests.fault_matrix.faulty_runs import FAULTS, SITUATIONS, behaviours, play
from tests.fault_matrix.outcomes import HEADING, row


def main() -> None:
    """Print the table line by line, then what was broken."""
    broken: Counter[str] = Counter()
    sys.stdout.write(HEADING)
    for fault in FAULTS:
        outcomes = {}
        for situation in SITUATIONS:
            runs = [play(fault, situation, how) for how in behaviours(fault, situation)]
            found = tuple(run.outcome for run in runs)
            outcomes[situation] = found if len(set(found)) > 1 else found[:1]
            for run in runs:
                broken.update(run.broken)
                if run.outcome != "no start" and not run.recovery.startswith("completed"):
                    broken[f"a new motion afterwards: {run.recovery}"] += 1
        sys.stdout.write(row(fault, outcomes))
        sys.stdout.flush()
    for text, count in broken.items():
        sys.stdout.write(f"BROKEN {count} times: {text}\n")
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    main()
