"""`python -m hil`, and the console script.

Linear algebra uses one thread unless the environment sets another number: the matrices are small,
and the rounding of sums would depend on the number of threads.
"""

from __future__ import annotations

import os

from hil.importing import leave_if_interrupted


def main() -> None:
    """Run the command line."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    with leave_if_interrupted():
        from hil.cli import main as command_line  # after the threads are settled

    command_line()


if __name__ == "__main__":
    main()
