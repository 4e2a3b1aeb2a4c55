"""Writes the last section of `wire.md` and its picture from the session's state table.

Positions of states are defined here; arrows and their labels come from `drivers.states`. The
picture has its own background, so that it is readable on light and dark pages.
"""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping
from html import escape
from pathlib import Path
from typing import Final

from drivers.states import TRANSITIONS, Input, State

PAGE: Final = Path(__file__).with_name("wire.md")
TARGET: Final = Path(__file__).with_name("state-machine.svg")
Table = Mapping[State, Mapping[Input, State]]

_TITLE: Final = "## The session's state machine"
_SOURCE: Final = """
This section and its picture are generated from the table `drivers.states.TRANSITIONS` by
`python docs/state_machine.py`; a test fails if they differ. The replies of each state are in the
docstring of `drivers/session.py`.
"""
_PICTURE: Final = "state-machine.svg"
_ANY: Final = "any state after init"


def label(member: State | Input) -> str:
    """Return the name of a member on the page."""
    return member.name.lower().replace("_", " ")


def common_inputs(table: Table) -> dict[Input, State]:
    """Return the inputs that lead to the same state from every started state, and that state.

    In started states the drive can be reported off: the init packet was received, and the session
    has not ended.
    """
    started = [row for row in table.values() if Input.OFF in row]
    leads_to = {what: {row.get(what) for row in started} for what in Input}
    return {
        what: after
        for what, targets in leads_to.items()
        if len(targets) == 1 and (after := next(iter(targets))) is not None
    }


def edges(table: Table) -> list[tuple[State | None, State, tuple[Input, ...]]]:
    """Return the arrows: from (None for every started state), to, and their inputs."""
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
    """Return the meaning of each input: the docstrings of the members of `Input`."""
    (enum,) = ast.parse(inspect.getsource(Input)).body
    assert isinstance(enum, ast.ClassDef)
    meaning_of: dict[Input, str] = {}
    last: Input | None = None
    for statement in enum.body:
        if isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            last = Input[statement.targets[0].id]
        elif isinstance(statement, ast.Expr) and last is not None:
            meaning_of[last] = " ".join(str(ast.literal_eval(statement.value)).split())
    return meaning_of


def input_table(table: Table = TRANSITIONS) -> str:
    """Return the meaning and target of each input as a Markdown table."""
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
    """Return the text of ``docs/wire.md`` with its last section as the table has it."""
    started = ", ".join(label(state) for state, row in TRANSITIONS.items() if Input.OFF in row)
    before, _, _ = PAGE.read_text("utf-8").partition(_TITLE)
    return (
        f"{before}{_TITLE}\n{_SOURCE}\n"
        f"![States of the session, and the inputs between them]({_PICTURE})\n\n"
        f'"{_ANY[0].upper() + _ANY[1:]}" means: {started}.\n\n### Inputs\n\n'
        "A cyclic packet is one input, which depends on the axes to be moved; the session adds "
        "further inputs. An input without a target in a state cannot occur in it.\n\n"
        f"{input_table()}"
    )


WIDTH = 1000
HEIGHT = 590
BOX: Final = (164.0, 50.0)
AT: Final = {
    State.SYNC: (110, 70),
    State.INIT: (370, 70),
    State.DRIVE_OFF: (610, 70),
    State.FREEZING: (850, 70),
    State.FAULTED: (610, 230),
    State.DRIVING_ON: (110, 370),
    State.CLOSED: (110, 500),
    State.OPENING: (490, 370),
    State.OPEN: (490, 500),
    State.EXITING: (850, 435),
    State.ENDED: (880, 250),
}
"""Centre of the box of each state."""
CORNERS: Final = {(State.FAULTED, State.SYNC): [(110.0, 230.0)]}
"""Corners of an arrow."""
FROM_BELOW: Final = (State.DRIVING_ON, State.CLOSED, State.FAULTED)
"""States whose arrow from any state comes from below, not from above."""
LABEL_AT: Final = {
    (State.DRIVING_ON, State.OPEN): 0.27,
    (State.CLOSED, State.OPENING): 0.27,
    (State.FAULTED, State.SYNC): 0.4,
    (State.INIT, State.FAULTED): 0.3,
    (State.DRIVE_OFF, State.FAULTED): 0.62,
    (State.FREEZING, State.FAULTED): 0.3,
}
"""Position of the label along an arrow, if not in the middle."""
STYLE: Final = """
  svg { --ink: #1a2026; --paper: #ffffff; --box: #e8eef4; --end: #fbe0e1; --line: #55606b; }
  @media (prefers-color-scheme: dark) {
    svg { --ink: #e4e9ee; --paper: #16181b; --box: #222d38; --end: #3a1c1f; --line: #a3aeb9; }
  }
  text { font: 13px system-ui, sans-serif; fill: var(--ink); text-anchor: middle; }
  .name { font-weight: 650; font-size: 14px; }
  .stays, .any { font-size: 12px; }
  .paper { fill: var(--paper); }
  .box { fill: var(--box); stroke: var(--line); }
  .bad { fill: var(--end); }
  .arrow { fill: none; stroke: var(--line); stroke-width: 1.4; }
  .head { fill: var(--line); }
"""

Point = tuple[float, float]


def svg(table: Table = TRANSITIONS) -> str:
    """Draw a table of states."""
    stays = {after: inputs for before, after, inputs in edges(table) if before == after}
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        'aria-label="States of the session and the inputs between them">',
        f"<style>{STYLE}</style>",
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" '
        'markerHeight="7" orient="auto-start-reverse"><path class="head" d="M0 0L10 5L0 10z"/>'
        "</marker></defs>",
        f'<rect class="paper" width="{WIDTH}" height="{HEIGHT}" rx="6"/>',
    ]
    for before, after, inputs in edges(table):
        if before is None:
            parts += _from_any(after, inputs)
        elif before != after:
            parts += _arrow(before, after, inputs)
    for state in table:
        parts += _box(state, stays.get(state, ()))
    parts.append(
        f'<text class="any" x="{WIDTH - 16}" y="{HEIGHT - 14}" style="text-anchor:end">'
        "short arrows: from any state after init · ↻ stays</text>"
    )
    return "\n".join([*parts, "</svg>", ""])


def _title(before: str, inputs: tuple[Input, ...], after: State) -> str:
    labels = ", ".join(label(what) for what in inputs)
    return f"<title>{escape(f'{before} | {labels} | {label(after)}')}</title>"


def _box(state: State, stays: tuple[Input, ...]) -> Iterator[str]:
    (x, y) = AT[state]
    (wide, tall) = BOX
    kind = "box bad" if state in (State.FAULTED, State.FREEZING) else "box"
    yield f'<rect class="{kind}" x="{x - wide / 2:g}" y="{y - tall / 2:g}" ' + (
        f'width="{wide:g}" height="{tall:g}" rx="8"/>'
    )
    yield f'<text class="name" x="{x}" y="{y - 3 if stays else y + 5}">{label(state)}</text>'
    if stays:
        labels = ", ".join(label(what) for what in stays)
        yield f"<g>{_title(label(state), stays, state)}"
        yield f'<text class="stays" x="{x}" y="{y + 15}">↻ {escape(labels)}</text></g>'


def _from_any(after: State, inputs: tuple[Input, ...]) -> Iterator[str]:
    """Draw the short arrow into a state for inputs from every started one."""
    (x, y) = AT[after]
    (wide, tall) = BOX
    below = after in FROM_BELOW
    begin = y + (tall / 2 + 24) * (1 if below else -1)
    end = y + tall / 2 * (1 if below else -1)
    shift = 0.36 * wide
    yield f"<g>{_title('any', inputs, after)}"
    yield (
        f'<path class="arrow" d="M{x - shift:g} {begin:g}V{end:g}" marker-end="url(#head)"/>'
        f'<text class="any" x="{x - shift + 5:g}" y="{begin + (6 if below else 2):g}" '
        f'style="text-anchor:start">{escape(", ".join(label(what) for what in inputs))}</text></g>'
    )


def _arrow(before: State, after: State, inputs: tuple[Input, ...]) -> Iterator[str]:
    corners = [AT[before], *CORNERS.get((before, after), ()), AT[after]]
    points = [
        _edge_of(corners[0], corners[1]),
        *corners[1:-1],
        _edge_of(corners[-1], corners[-2]),
    ]
    path = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    (ax, ay) = points[0]
    (bx, by) = points[1]
    share = LABEL_AT.get((before, after), 0.5)
    x = ax + share * (bx - ax)
    y = ay + share * (by - ay)
    labels = ", ".join(label(what) for what in inputs)
    size = 6.7 * len(labels) + 8
    yield f"<g>{_title(label(before), inputs, after)}"
    yield f'<path class="arrow" d="M{path}" marker-end="url(#head)"/>'
    yield f'<rect class="paper" x="{x - size / 2:.1f}" y="{y - 9:.1f}" ' + (
        f'width="{size:.1f}" height="18"/>'
    )
    yield f'<text x="{x:.1f}" y="{y + 4:.1f}">{escape(labels)}</text></g>'


def _edge_of(middle: Point, towards: Point) -> Point:
    """Return the point where the line from the centre of a box leaves it."""
    dx = towards[0] - middle[0]
    dy = towards[1] - middle[1]
    share = min(
        BOX[0] / 2 / abs(dx) if dx else 1.0,
        BOX[1] / 2 / abs(dy) if dy else 1.0,
    )
    return middle[0] + share * dx, middle[1] + share * dy


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    TARGET.write_text(svg(), encoding="utf-8")
