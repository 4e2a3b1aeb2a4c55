"""Templates of the pages, and the numbering of figures and tables."""

from __future__ import annotations

import base64
import hashlib
import itertools
import os
import re
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Final

import jinja2
from jinja2 import (
    BytecodeCache,
    Environment,
    FileSystemBytecodeCache,
    FileSystemLoader,
    StrictUndefined,
)
from markupsafe import Markup
from markupsafe import escape as escape_html

from hil.base.files import digest, user_cache
from hil.base.terminal_text import escape
from hil.report import numbers
from identification.text import unit_text

_TEMPLATES: Final = Path(__file__).parent / "templates"
_STYLE: Final = "report.css"
_SCRIPT: Final = "page.js"
_FORMATS: Final = (
    *("significant", "fixed", "beside", "percent", "with_std"),
    *("capitalised", "moments"),
)
_STEERING: Final = re.compile(
    r"[\0-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069]"
)
"""Control characters, and characters that change the text direction (Unicode Annex 9)."""


def environment(*scripts: str) -> Environment:
    """Return the template environment, with the formats of :mod:`hil.report.numbers` as filters.

    A page runs these scripts in their order, and then its own.
    """
    # Autoescape always: names come from archives, which may be untrusted.
    environment = Environment(
        loader=FileSystemLoader(_TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        finalize=_shown,
        bytecode_cache=_compiled_templates(),
    )
    every = [*scripts, template_text(_SCRIPT)]
    environment.globals |= {
        "style": Markup(template_text(_STYLE)),
        "scripts": [Markup(script) for script in every],
        "policy": policy(every),
    }
    # Figures and tables are numbered in the order of the page.
    figures = itertools.count(1)
    tables = itertools.count(1)
    numbering = {"figure": lambda: next(figures), "table": lambda: next(tables)}
    environment.globals |= {"numbers": numbers, "numbering": numbering}
    for name in _FORMATS:
        environment.filters[name] = getattr(numbers, name)
    environment.filters |= {"unit_text": unit_text, "prose": _prose}
    return environment


def _compiled_templates() -> BytecodeCache | None:
    """Return the cache of compiled templates, whose compilation takes longer than a page.

    None if the user's cache folder cannot be written.
    """
    # Of this version of jinja2 and of these settings; jinja2 checks the text of each template.
    key = digest(f"{jinja2.__version__} {sys.version} {Path(__file__).read_text('utf-8')}")
    folder = user_cache() / f"templates-{key[:16]}"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if folder.stat().st_uid != os.getuid() or not os.access(folder, os.W_OK | os.X_OK):
            return None
    except (OSError, RuntimeError):  # no home
        return None
    return FileSystemBytecodeCache(str(folder))


def _prose(text: str) -> Markup:
    """Return a message as HTML: `commands` as code, per cent signs on the line of their numbers."""
    safe = str(escape_html(_STEERING.sub(lambda match: escape(match[0]), numbers.prose(text))))
    return Markup(re.sub(r"`([^`]+)`", r"<code>\1</code>", safe))


def _shown(value: object) -> object:
    """Escape control and direction characters of a text."""
    if isinstance(value, Markup) or not isinstance(value, str):
        return value
    return _STEERING.sub(lambda match: escape(match[0]), value)


def template_text(name: str) -> str:
    """Return a style sheet or a script from the folder of templates."""
    return (_TEMPLATES / name).read_text("utf-8")


def policy(scripts: Iterable[str]) -> str:
    """Return the content security policy: no external resource, and these scripts only."""
    digests = (
        base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii")
        for script in scripts
    )
    sources = " ".join(f"'sha256-{digest}'" for digest in digests)
    return (
        f"default-src 'none'; script-src {sources}; style-src 'unsafe-inline'; "
        "img-src data:; base-uri 'none'; form-action 'none'"
    )


def page_bytes(text: str) -> bytes:
    """Encode a page."""
    # A name from an archive may contain lone surrogates, which UTF-8 cannot encode.
    return text.encode("utf-8", errors="replace")
