"""The picture of an archive as one self-contained HTML file, with its events and facts."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined

from hil.plots import style
from hil.plots.archive_picture import draw_archive
from hil.plots.archive_view import ArchiveView
from hil.report.figures.svg import to_panel

_TEMPLATES: Final = Path(__file__).parent / "templates"


def archive_page(view: ArchiveView) -> bytes:
    """The page; the same archive gives the same bytes."""
    figure = draw_archive(view)
    facts = view.facts
    title = f"{facts.title} of {', '.join(view.joint_names)}"
    with style.page():
        panel = to_panel(
            figure, key="archive", title=title, note="", alt=f"Signals over time: {title}"
        )
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    rows = [
        ("joints", ", ".join(facts.joint_names)),
        ("cycle", "not fixed" if facts.period is None else f"{1e3 * facts.period:g} ms"),
        ("lost", facts.lost or "nothing"),
        ("damage", facts.damage or "none"),
        ("attachments", ", ".join(facts.attachments)),
        *facts.metadata.items(),
    ]
    text = environment.get_template("archive.html.j2").render(
        facts=facts, svg=panel.svg, events=view.events, rows=rows
    )
    return text.encode("utf-8", errors="replace")
