"""An archive as one self-contained HTML file: its joints over time, its events and facts."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from jinja2 import ChoiceLoader, FileSystemLoader

from hil.plots.archive_panels import archive_panels
from hil.plots.archive_view import ArchiveView
from hil.report.rendering import environment, page_bytes

_TEMPLATES: Final = Path(__file__).parent / "templates"


def archive_page(view: ArchiveView) -> bytes:
    """The page; the same archive gives the same bytes.

    Args:
        view: read with `hil.plots.archive_panels.BINS`, so that there is something to zoom into.
    """
    facts = view.facts
    known = environment()
    assert known.loader is not None  # where macros and style sheet of all pages lie
    known.loader = ChoiceLoader([FileSystemLoader(_TEMPLATES), known.loader])
    shown = f"{view.start:.3f} s to {view.stop:.3f} s of {facts.duration:.3f} s"
    rows = [
        ("shown", shown),
        ("frame", view.frame),
        ("joints", ", ".join(facts.joint_names)),
        ("cycle", "not fixed" if facts.period is None else f"{1e3 * facts.period:g} ms"),
        ("samples", str(facts.samples)),
        *_missed(view),
        ("lost", facts.lost or "nothing"),
        ("damage", facts.damage or "none"),
        ("attachments", ", ".join(facts.attachments)),
        *facts.metadata.items(),
    ]
    text = known.get_template("archive.html.j2").render(
        facts=facts,
        joints=archive_panels(view),
        events=view.events,
        states=view.states,
        simulated=facts.metadata.get("simulated") == "yes",
        rows=rows,
    )
    return page_bytes(text)


def _missed(view: ArchiveView) -> list[tuple[str, str]]:
    """Where packets were missed; nothing where nobody counted them."""
    if not view.states:
        return []
    places = f"at {len(view.gaps)} place{'s' * (len(view.gaps) > 1)}"
    return [("packets missed", places if len(view.gaps) else "none")]
