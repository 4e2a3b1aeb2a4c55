"""Run every fault in every situation and print the outcomes: `python -m tests.fault_matrix`.

The tests read the same table in docs/limits.md; exit status 1 if a law was broken.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Final

from tests.fault_matrix import faulty_runs, ur_runs
from tests.fault_matrix.faulty_runs import Run

DOCUMENT: Final = Path(__file__).parents[2] / "docs" / "limits.md"
Outcomes = Mapping[str, tuple[str, ...]]
"""By situation or speed: one, or one for each behaviour of the controller."""


def expected(first: str) -> dict[str, Outcomes]:
    """Outcomes by fault, of the table in the document whose first column after them is this one."""
    _, _, text = DOCUMENT.read_text("utf-8").partition(f"| fault | {first} |")
    heading, _, rows = text.partition("\n|---")
    columns = [first, *_cells(heading)]
    table: dict[str, Outcomes] = {}
    for line in rows.partition("\n\n")[0].splitlines()[1:]:
        fault, *cells = _cells(line)
        outcomes = (tuple(cell.split(" / ")) for cell in cells)
        table[fault] = dict(zip(columns, outcomes, strict=True))
    return table


def _cells(line: str) -> list[str]:
    return [cell.strip() for cell in line.strip().strip("|").split("|")]


def _of_c4g() -> Iterator[tuple[str, list[list[Run]]]]:
    for fault in faulty_runs.FAULTS:
        yield (
            fault,
            [
                [faulty_runs.play(fault, at, how) for how in faulty_runs.behaviours(fault, at)]
                for at in faulty_runs.SITUATIONS
            ],
        )


def _of_ur() -> Iterator[tuple[str, list[list[Run]]]]:
    for fault in ur_runs.FAULTS:
        yield fault, [[ur_runs.play(fault, at)] for at in ur_runs.SITUATIONS]


def main() -> None:
    """Print the tables line by line, then what was broken."""
    broken: Counter[str] = Counter()
    for situations, rows in (
        (faulty_runs.SITUATIONS, _of_c4g()),
        (ur_runs.SITUATIONS, _of_ur()),
    ):
        sys.stdout.write("| fault | " + " | ".join(situations) + " |\n")
        sys.stdout.write("|---" * (len(situations) + 1) + "|\n")
        for fault, of_situations in rows:
            cells = [fault]
            for runs in of_situations:
                outcomes = [run.outcome for run in runs]
                cells.append(" / ".join(outcomes if len(set(outcomes)) > 1 else outcomes[:1]))
                for run in runs:
                    broken.update((text for _, text in run.broken))
                    if run.outcome != "no start" and not run.recovery.startswith("completed"):
                        broken[f"a new motion afterwards: {run.recovery}"] += 1
            sys.stdout.write("| " + " | ".join(cells) + " |\n")
            sys.stdout.flush()
        sys.stdout.write("\n")
    for text, count in broken.items():
        sys.stdout.write(f"BROKEN {count} times: {text}\n")
    sys.exit(1 if broken else 0)


if __name__ == "__main__":
    main()
