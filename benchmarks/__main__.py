"""The benchmarks that can be run, each with what it measures: `make bench`.

`python -m benchmarks` prints the same.
"""

from __future__ import annotations

import ast
from pathlib import Path

HELPERS = ("figaroh_rival", "fresh_process", "plain_fit")
"""Programs that benchmarks start; a person does not."""


def listed() -> dict[str, str]:
    """Return the first line of each benchmark's docstring, by its name."""
    found = {}
    for path in sorted(Path(__file__).parent.glob("[a-z]*.py")):
        source = path.read_text("utf-8")
        if '__name__ == "__main__"' in source and path.stem not in HELPERS:
            found[path.stem] = (ast.get_docstring(ast.parse(source)) or "").splitlines()[0]
    return found


if __name__ == "__main__":
    print("\n".join(f"python -m benchmarks.{name:22}{line}" for name, line in listed().items()))
    print("Options: --help of each; figures measured by them: benchmarks/performance.md")
