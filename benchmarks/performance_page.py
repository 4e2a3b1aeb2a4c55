"""Figures of performance and precision, each with its command: writes performance.md.

`figures.toml` has them; who measures one again corrects it there.
"""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

PAGE = Path(__file__).with_name("performance.md")
FIGURES = PAGE.with_name("figures.toml")


def figures() -> dict[str, Any]:
    """Return the tables of the figures."""
    return tomllib.loads(FIGURES.read_text("utf-8"))


def page() -> str:
    """Return the page in Markdown."""
    content = figures()
    rows = (
        f"| {row['quantity']} | {row['value']} | {row['command']} |" for row in content["figure"]
    )
    table = "\n".join(("| quantity | value | command |", "|---|---|---|", *rows))
    sections = (f"## {each['title']}\n\n{each['text'].strip()}" for each in content["section"])
    return "\n\n".join(("# Performance", content["introduction"], table, *sections)) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(), "utf-8")
