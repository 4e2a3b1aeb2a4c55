"""A screen on a terminal, for a test at the other end: writes what it was asked for to a file.

`python screen_rig.py FILE ENDING`: shows a run until it is stopped, then ends in one of several
ways, among them those that leave a terminal in a bad state. A line of JSON in FILE for each wish.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import numpy as np

from drivers.states import State
from hil.campaign import stop_on_interrupt
from hil.campaign.dry_run import DryRun
from hil.campaign.operator import MotionProgress, OperatorRequest, RunStatus
from hil.screen import Screen

LONGEST = 60.0
"""s after which it gives up."""
NAMES = ("joint_1", "joint_2")


def status(wish: OperatorRequest) -> RunStatus:
    """In the third repetition, doing as wished."""
    share, zero = np.array([0.1, 0.9]), np.zeros(2)
    motion = MotionProgress(
        1.0, 4.0, 1000, 0, 0, 0, State.OPEN, zero, zero, share, zero, share,
        override=wish.override, held=wish.held,
    )  # fmt: skip
    return RunStatus("repetition", 3, 30, 65.0, motion)


def main() -> int:
    """Run it."""
    file, ending = Path(sys.argv[1]), sys.argv[2]
    with stop_on_interrupt() as stop, Screen(NAMES, stop, title="rig") as screen:
        with file.open("w", buffering=1) as reported:
            last: OperatorRequest | None = None
            until = time.monotonic() + LONGEST
            if ending in ("question", "contradiction"):
                found = DryRun(
                    "0" * 64, 0.2, ("dryrun_000_a1.mcap",), 12.0, True, NAMES,
                    (0.2, 0.4), (0.001, 0.002), 0, 0,
                    against_gravity=NAMES[1:] if ending == "contradiction" else (),
                )  # fmt: skip
                for _ in range(3):
                    reported.write(json.dumps({"accepted": screen.accept_dry_run(found)}) + "\n")
            while not stop.requested and time.monotonic() < until:
                wish = screen.request()
                screen.show(status(wish))
                if wish != last:
                    last = wish
                    said = {"override": round(wish.override, 3), "held": wish.held}
                    reported.write(json.dumps(said) + "\n")
                time.sleep(0.01)
            reported.write(json.dumps({"stop": stop.requested}) + "\n")
        screen.say("the last line")
        if ending == "error":
            raise RuntimeError("an error on the way")
        if ending == "exit":
            sys.exit(7)
    return 0


if __name__ == "__main__":
    sys.exit(main())
