"""Formulae as MathML, which browsers draw by themselves: no script, font or TeX is needed.

Sphinx's own renderers load MathJax or call TeX.
"""

from __future__ import annotations

from html import escape
from typing import Any

from docutils import nodes
from latex2mathml.converter import convert
from sphinx.errors import ExtensionError


def mathml(latex: str, *, block: bool) -> str:
    """A formula for the page.

    Raises:
        ExtensionError: it cannot be converted; the build ends rather than show half of it.
    """
    try:
        return convert(latex.strip(), display="block" if block else "inline")
    except Exception as error:  # the converter has no base class of its own
        raise ExtensionError(f"the formula {latex!r} cannot be converted: {error!r}") from error


def _inline(self: Any, node: nodes.math) -> None:
    self.body.append(mathml(node.astext(), block=False))
    raise nodes.SkipNode


def _block(self: Any, node: nodes.math_block) -> None:
    number = f'<span class="eqno">({escape(node["number"])})</span>' if node["number"] else ""
    self.body.append(f'<div class="math">{number}{mathml(node.astext(), block=True)}</div>\n')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, bool]:
    """Register the renderer `mathml`."""
    app.add_html_math_renderer("mathml", (_inline, None), (_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
