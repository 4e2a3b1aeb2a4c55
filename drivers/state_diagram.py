"""The session's state table as a page: its arrows and tables, made from `drivers.states` alone.

``python -m drivers.state_diagram`` prints the page that stands in ``docs/state-machine.md``.
"""

from __future__ import annotations

import ast
import inspect
import sys
from collections.abc import Mapping
from typing import Final

from drivers.states import TRANSITIONS, Input, State

Table = Mapping[State, Mapping[Input, State]]

_TITLE: Final = """# The session's state machine

This page is made from the table `drivers.states.TRANSITIONS` by
`python -m drivers.state_diagram`, and its picture by `python docs/state_machine_svg.py`; a test
fails where they differ. What each state is answered with stands at the head of
`drivers/session.py`.
"""
_PICTURE: Final = "state-machine.svg"
_ANY: Final = "any state after init"


def label(member: State | Input) -> str:
    """A member's name as it is written on the page."""
    return member.name.lower().replace("_", " ")


def common_inputs(table: Table) -> dict[Input, State]:
    """Inputs that lead to one and the same state from every started state, with that state.

    A state is started if the drive can be reported off in it: the init packet came, the session
    has not ended.
    """
    started = [row for row in table.values() if Input.OFF in row]
    leads_to = {what: {row.get(what) for row in started} for what in Input}
    return {
        what: after
        for what, found in leads_to.items()
        if len(found) == 1 and (after := next(iter(found))) is not None
    }


def edges(table: Table) -> list[tuple[State | None, State, tuple[Input, ...]]]:
    """The arrows of the diagram: from (None for every started state), to, and inputs merged."""
    common = common_inputs(table)
    merged: dict[tuple[State | None, State], list[Input]] = {}
    for before, row in table.items():
        for what, after in row.items():
            shared = Input.OFF in row and what in common
            merged.setdefault((None if shared else before, after), []).append(what)
    return [
        (before, after, tuple(sorted(set(inputs))))
        for (before, after), inputs in sorted(
            merged.items(), key=lambda item: (-1 if item[0][0] is None else item[0][0], item[0][1])
        )
    ]


def meanings() -> dict[Input, str]:
    """What each input means: the sentences below the members in the source of `Input`."""
    (enum,) = ast.parse(inspect.getsource(Input)).body
    assert isinstance(enum, ast.ClassDef)
    found: dict[Input, str] = {}
    last: Input | None = None
    for statement in enum.body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            last = Input[statement.targets[0].id]
        elif isinstance(statement, ast.Expr) and last is not None:
            found[last] = " ".join(str(ast.literal_eval(statement.value)).split())
    return found


def input_table(table: Table = TRANSITIONS) -> str:
    """What each input means, and where it leads, as a Markdown table."""
    texts = meanings()
    lines = ["| input | meaning | leads to |", "|---|---|---|"]
    for what in Input:
        targets: dict[State, list[str]] = {}
        for before, after, inputs in edges(table):
            if what in inputs:
                targets.setdefault(after, []).append(_ANY if before is None else label(before))
        leads = "; ".join(
            f"**{label(after)}** from {', '.join(sources)}" for after, sources in targets.items()
        )
        lines.append(f"| {label(what)} | {texts[what]} | {leads or 'nowhere'} |")
    return "\n".join(lines) + "\n"


def page() -> str:
    """The whole of ``docs/state-machine.md``."""
    started = ", ".join(label(state) for state, row in TRANSITIONS.items() if Input.OFF in row)
    return (
        f"{_TITLE}\n![States of the session, and what leads from one to the next]({_PICTURE})\n\n"
        f'"{_ANY[0].upper() + _ANY[1:]}" stands for: {started}.\n\n## Inputs\n\n'
        "A cyclic packet is read as one input, judged by the axes that are to be moved; the "
        "session adds inputs of its own. What leads nowhere in a state cannot happen in it.\n\n"
        f"{input_table()}"
    )


if __name__ == "__main__":
    sys.stdout.write(page())
