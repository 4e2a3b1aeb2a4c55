"""Draws `state-machine.svg` from the session's state table.

``python docs/state_machine_svg.py`` writes the picture beside this file.

Where a state stands is said here; which arrows there are, and their words, comes from
`drivers.states` alone. Every arrow carries a title "from | inputs | to", by which it is read back.
The picture brings its own paper, so that it can be read on a light page and on a dark one.
"""

from __future__ import annotations

from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Final

from drivers.state_diagram import Table, edges, label
from drivers.states import TRANSITIONS, Input, State

TARGET: Final = Path(__file__).with_name("state-machine.svg")
WIDTH, HEIGHT = 1000, 590
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
"""Middle of each state's box."""
CORNERS: Final = {(State.FAULTED, State.SYNC): [(110.0, 230.0)]}
"""Where an arrow turns on its way."""
FROM_BELOW: Final = (State.DRIVING_ON, State.CLOSED, State.FAULTED)
"""States whose arrow from any state comes from below: the others' comes from above."""
LABEL_AT: Final = {
    (State.DRIVING_ON, State.OPEN): 0.27,
    (State.CLOSED, State.OPENING): 0.27,
    (State.FAULTED, State.SYNC): 0.4,
    (State.INIT, State.FAULTED): 0.3,
    (State.DRIVE_OFF, State.FAULTED): 0.62,
    (State.FREEZING, State.FAULTED): 0.3,
}
"""Where along an arrow its words stand, if not in the middle."""
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
    """The picture of a table of these states."""
    stays = {after: inputs for before, after, inputs in edges(table) if before == after}
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" '
        'aria-label="States of the session and what leads from one to the next">',
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
    words = ", ".join(label(what) for what in inputs)
    return f"<title>{escape(f'{before} | {words} | {label(after)}')}</title>"


def _box(state: State, stays: tuple[Input, ...]) -> Iterator[str]:
    (x, y), (wide, tall) = AT[state], BOX
    kind = "box bad" if state in (State.FAULTED, State.FREEZING) else "box"
    yield f'<rect class="{kind}" x="{x - wide / 2:g}" y="{y - tall / 2:g}" ' + (
        f'width="{wide:g}" height="{tall:g}" rx="8"/>'
    )
    yield f'<text class="name" x="{x}" y="{y - 3 if stays else y + 5}">{label(state)}</text>'
    if stays:
        words = ", ".join(label(what) for what in stays)
        yield f"<g>{_title(label(state), stays, state)}"
        yield f'<text class="stays" x="{x}" y="{y + 15}">↻ {escape(words)}</text></g>'


def _from_any(after: State, inputs: tuple[Input, ...]) -> Iterator[str]:
    """A short arrow into a state, for inputs that lead there from every started one."""
    (x, y), (wide, tall) = AT[after], BOX
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
    way = [AT[before], *CORNERS.get((before, after), ()), AT[after]]
    points = [_edge_of(way[0], way[1]), *way[1:-1], _edge_of(way[-1], way[-2])]
    path = "L".join(f"{x:.1f} {y:.1f}" for x, y in points)
    (ax, ay), (bx, by) = points[0], points[1]
    share = LABEL_AT.get((before, after), 0.5)
    x, y = ax + share * (bx - ax), ay + share * (by - ay)
    words = ", ".join(label(what) for what in inputs)
    size = 6.7 * len(words) + 8
    yield f"<g>{_title(label(before), inputs, after)}"
    yield f'<path class="arrow" d="M{path}" marker-end="url(#head)"/>'
    yield f'<rect class="paper" x="{x - size / 2:.1f}" y="{y - 9:.1f}" ' + (
        f'width="{size:.1f}" height="18"/>'
    )
    yield f'<text x="{x:.1f}" y="{y + 4:.1f}">{escape(words)}</text></g>'


def _edge_of(middle: Point, towards: Point) -> Point:
    """Where the straight line from a box's middle leaves it."""
    dx, dy = towards[0] - middle[0], towards[1] - middle[1]
    share = min(
        BOX[0] / 2 / abs(dx) if dx else 1.0,
        BOX[1] / 2 / abs(dy) if dy else 1.0,
    )
    return middle[0] + share * dx, middle[1] + share * dy


if __name__ == "__main__":
    TARGET.write_text(svg(), encoding="utf-8")
