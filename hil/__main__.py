"""`python -m hil`, and the console script.

Linear algebra uses one thread, see :mod:`hil.base.threads`; set here, before numpy is loaded.
"""

from __future__ import annotations

import os

from hil.base.interrupt import leave_if_interrupted
from hil.base.threads import VARIABLES


def main() -> None:
    """Run the command line."""
    for variable in VARIABLES:
        os.environ.setdefault(variable, "1")
    with leave_if_interrupted():
        from hil.cli import main as command_line  # after the threads are settled

    command_line()


if __name__ == "__main__":
    main()
