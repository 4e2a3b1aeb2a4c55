"""What every page is made with: the templates, and the numbering of figures and tables."""

from __future__ import annotations

import base64
import hashlib
import itertools
from pathlib import Path
from typing import Final

from jinja2 import Environment, FileSystemLoader, StrictUndefined
from markupsafe import Markup

_TEMPLATES: Final = Path(__file__).parent / "templates"


_STYLE: Final = "report.css"
_SCRIPT: Final = "page.js"


class Numbering:
    """Numbers figures and tables in the order in which the page shows them."""

    def __init__(self) -> None:
        self._figures, self._tables = itertools.count(1), itertools.count(1)

    def figure(self) -> int:
        """The next figure's."""
        return next(self._figures)

    def table(self) -> int:
        """The next table's."""
        return next(self._tables)


def environment() -> Environment:
    """The templates of the pages: `page.html.j2` is what all of them extend.

    It has the one style sheet and the one script that the policy of the page lets run.
    """
    # Autoescape without conditions: names come out of archives, and archives out of anywhere.
    found = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    style, script = ((_TEMPLATES / name).read_text("utf-8") for name in (_STYLE, _SCRIPT))
    found.globals |= {"style": Markup(style), "script": Markup(script), "policy": policy(script)}
    return found


def policy(script: str) -> str:
    """What a browser lets the page do: nothing from outside, and no script but this one."""
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
    return (
        f"default-src 'none'; script-src 'sha256-{digest}'; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def page_bytes(text: str) -> bytes:
    """A page as it is written; the same text gives the same bytes."""
    # A name read from an archive may hold what UTF-8 cannot; the page must come out all the same.
    return text.encode("utf-8", errors="replace")
