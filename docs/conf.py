"""Sphinx: the pages of this folder and the API reference, as HTML that opens offline."""

from __future__ import annotations

import sys
from importlib.metadata import version as version_of
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent / "_ext"))

project = "hil"
author = "the hil project"
copyright = "Apache-2.0"  # noqa: A001 - Sphinx's name
release = version = version_of("hil")

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "linked_names",
    "offline_math",
]
exclude_patterns = ["_build"]
source_suffix = {".md": "markdown"}

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 4
myst_dmath_double_inline = True

highlight_language = "none"  # shell lines, verdicts and file excerpts are no Python
default_role = "literal"  # docstrings write names in single backticks
add_module_names = False
toc_object_entries = False
autodoc_typehints_format = "short"
autodoc_member_order = "bysource"
autodoc_inherit_docstrings = False
python_display_short_literal_types = True
python_maximum_signature_line_length = 110
napoleon_custom_sections = [("Attributes", "params_style")]  # no links from bare names
napoleon_use_rtype = False

html_theme = "furo"
html_title = f"hil {release}"
html_math_renderer = "mathml"
html_show_sphinx = False
html_show_copyright = False
html_copy_source = False
html_static_path = ["_static"]
html_css_files = ["hil.css"]
html_theme_options = {"source_repository": "", "navigation_with_keys": True}
pygments_style = "tango"
pygments_dark_style = "monokai"
