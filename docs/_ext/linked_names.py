"""Names of the package in running text become links to the API reference.

A name in backticks, such as `identification.estimate` or `Session`, is linked to its documentation.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from docutils import nodes
from sphinx.transforms.post_transforms import SphinxPostTransform
from sphinx.util.nodes import make_refnode

_CODE = re.compile(r"(?<!`)`([^`\n]+)`(?!`)")
_NAME = re.compile(r"[\w.]+")

Place = tuple[str, str]
"""Page and anchor."""


def places(objects: Mapping[str, Any]) -> dict[str, Place]:
    """Return the place of each full name, and of the last part of classes where it is unique."""
    full = {name: (entry.docname, entry.node_id) for name, entry in objects.items()}
    short: dict[str, set[Place]] = {}
    for name, entry in objects.items():
        if entry.objtype in ("class", "exception"):
            short.setdefault(name.rpartition(".")[2], set()).add(full[name])
    unique = {name: candidates.pop() for name, candidates in short.items() if len(candidates) == 1}
    return unique | full


class LinkedNames(SphinxPostTransform):
    """Wraps code literals that are documented objects in references to them."""

    default_priority = 400

    def run(self, **_: Any) -> None:
        """Link every literal of the page that is a documented name."""
        place_of = places(self.env.domains.python_domain.objects)
        page = self.env.current_document.docname
        for literal in list(self.document.findall(nodes.literal)):
            place = place_of.get(literal.astext().removesuffix("()"))
            if place is not None and not isinstance(literal.parent, nodes.reference):
                link = make_refnode(self.app.builder, page, *place, literal.deepcopy())
                literal.replace_self(link)


def restructured_docstring(
    _app: Any, what: str, _name: str, _of: Any, _options: Any, lines: list[str]
) -> None:
    """Convert a docstring to reStructuredText.

    Any `code` is a literal, |x| a magnitude, text between lines of three backticks a code block.
    """
    # An empty comment: else napoleon reads the first line of a property as "type: description".
    converted = ["..", ""] if what in ("property", "attribute", "data") else []
    fenced = False
    for line in lines:
        if line.strip() == "```":
            fenced = not fenced
            converted += ["::", ""] if fenced else [""]
        elif fenced:
            converted.append(f"    {line}")
        else:
            converted.append(_marked_up(line))
    lines[:] = converted


def _marked_up(line: str) -> str:
    """Return a line with its code as literals, and with bars escaped outside of them."""
    parts = re.split(r"(``.*?``)", _CODE.sub(_literal, line))
    return "".join(part if part.startswith("``") else part.replace("|", r"\|") for part in parts)


def _literal(code: re.Match[str]) -> str:
    before = code.string[: code.start()][-1:]
    apart = "" if before in ("", *" ([\"'-/") else "\\ "  # markup begins after a blank
    return apart + (code[0] if _NAME.fullmatch(code[1]) else f"`{code[0]}`")


def setup(app: Any) -> dict[str, bool]:
    """Register both."""
    app.add_post_transform(LinkedNames)
    app.connect(
        "autodoc-process-docstring", restructured_docstring, priority=400
    )  # before napoleon
    return {"parallel_read_safe": True, "parallel_write_safe": True}
