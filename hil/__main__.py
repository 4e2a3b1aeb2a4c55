"""`python -m hil`, and the console script.

One thread of linear algebra unless the environment says otherwise: the matrices are small, more
threads only get into each other's way, and sums would depend on how many there are.
"""

from __future__ import annotations

import os
import signal
import sys
from types import FrameType
from typing import Any, NoReturn


def main() -> None:
    """Run the command line."""
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    before: Any = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # not where a shell has it ignored
        signal.signal(signal.SIGINT, _leave)
    from hil.cli import main as command_line  # after the threads are settled

    signal.signal(signal.SIGINT, before)
    command_line()


def _leave(signum: int, frame: FrameType | None) -> NoReturn:
    """Leave at once: an import that is interrupted fails in ways of its own, and holds nothing."""
    del signum, frame
    sys.stderr.write("error: interrupted\n")
    sys.stderr.flush()
    os._exit(130)


if __name__ == "__main__":
    main()
