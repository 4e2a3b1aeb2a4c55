"""Colours by role. Figures draw with stand-ins; the style sheet says what they look like.

A stand-in is a colour no one would draw with; it becomes a CSS variable when the figure enters the
page, so that light, dark and print need no second drawing.
"""

from __future__ import annotations

INK = "#010201"
MUTED = "#010202"
GRID = "#010203"
BAND = "#010204"
PAPER = "#010205"
FIRST = "#010206"
SECOND = "#010207"
WIDE = "#010208"
"""A light, broad line that another one may lie upon."""
ROUTES = ("#010209", "#01020a", "#01020b", "#01020c")
INSIDE, OUTSIDE_2, OUTSIDE_3 = "#01020d", "#01020e", "#01020f"

CSS_VARIABLES = {
    INK: "var(--ink)",
    MUTED: "var(--muted)",
    GRID: "var(--grid)",
    BAND: "var(--band)",
    PAPER: "var(--paper)",
    FIRST: "var(--first)",
    SECOND: "var(--second)",
    WIDE: "var(--wide)",
    ROUTES[0]: "var(--route-0)",
    ROUTES[1]: "var(--route-1)",
    ROUTES[2]: "var(--route-2)",
    ROUTES[3]: "var(--route-3)",
    INSIDE: "var(--inside)",
    OUTSIDE_2: "var(--outside-2)",
    OUTSIDE_3: "var(--outside-3)",
}
