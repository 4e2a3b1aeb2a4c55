"""Asking the person whether the dry run looked right."""

from __future__ import annotations

import contextlib
import math
import select
import sys
import termios
from typing import Final

from rich.console import Console
from rich.table import Table
from rich.text import Text

from hil.campaign.gravity_check import AGAINST
from hil.campaign.operator import DryRunSummary
from hil.campaign.stop import Stop
from hil.counted import counted
from hil.printable import printable

from . import marks

_LOOK: Final = 0.2


def ask(console: Console, summary: DryRunSummary, stop: Stop) -> bool:
    """Show what was measured and wait for an answer; only "yes" accepts.

    Where torques contradict the model, only the names of the joints concerned do.

    A stop asked for meanwhile is a refusal. It is looked for while nothing is typed, so that the
    heartbeat of a real link goes on and Ctrl-C needs no answer.
    """
    console.print(_table(summary))
    what = "the simulated arm" if summary.simulated else "the arm"
    word = " ".join(summary.against_gravity) or "yes"
    for joint in summary.against_gravity:
        console.print(f"{joint}: {AGAINST}", style="bold red", markup=False, highlight=False)
    known = f"If you know why, type {word}" if summary.against_gravity else "Type yes"
    console.print(
        f"Did {what} move as it should, with nothing in its way at {summary.override:.0%} of full "
        f"speed? {known} to accept; anything else ends the run: ",
        end="", markup=False, highlight=False,
    )  # fmt: skip
    sys.stdout.flush()
    with contextlib.suppress(termios.error):  # what was typed before the question is no answer
        termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)
    while not stop.requested:
        with contextlib.suppress(InterruptedError):
            if select.select([sys.stdin], [], [], _LOOK)[0]:
                answer = sys.stdin.readline().split()
                return " ".join(answer).lower() == word.lower()
    return False


def _table(summary: DryRunSummary) -> Table:
    title = f"Dry run of {summary.campaign}, {marks.clock(summary.duration)} long"
    table = Table(title=Text(printable(title)))
    table.add_column("joint")
    table.add_column("largest following error", justify="right")
    table.add_column("largest current", justify="right")
    table.add_column("torque and weight")
    for name, error, share in zip(
        summary.joint_names, summary.following_error, summary.current_share, strict=True
    ):
        degrees = f"{math.degrees(error):.3f}°"
        agree = Text("agree")
        if name in summary.against_gravity:
            agree = Text("contradict", style="bold red")
        elif name in summary.gravity_not_seen:
            agree = Text("not seen")
        table.add_row(Text(printable(name)), degrees, f"{100.0 * share:.0f} % of its limit", agree)
    archives = ", ".join(summary.archives)
    link = f"{counted(summary.missed, 'packet')} missed, {counted(summary.late, 'answer')} late"
    table.caption = Text(printable(f"{link}; {archives}"))
    return table
