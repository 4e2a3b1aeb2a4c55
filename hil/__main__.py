"""`python -m hil`, and the console script.

One thread of linear algebra unless the environment says otherwise: the matrices are small, more
threads only get into each other's way, and sums would depend on how many there are.
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
