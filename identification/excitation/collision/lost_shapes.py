"""Which collision shapes of a robot description its reader left out, as it does without an error.

It keeps none of a link of which it cannot read one, be it a visual one, and of several in one
<geometry> only the first.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Final
from xml.etree.ElementTree import Element

from identification.urdf_tree import urdf_tree

_SHAPES: Final = ("box", "cylinder", "sphere", "mesh")


def lost_shapes(urdf: str, links: Iterable[str]) -> str | None:
    """Return in words the first link of which shapes were left out, and why; None if of none.

    Args:
        urdf: text of the description.
        links: the link of each shape that was read.

    Raises:
        ModelError: the text is no XML.
    """
    read = Counter(links)
    for link in urdf_tree(urdf).findall("link"):
        name = link.get("name", "")
        collisions = link.findall("collision")
        written = sum(max(1, len(list(_shapes(shape)))) for shape in collisions)
        if read[name] == written:
            continue
        found = f"of the {written} collision shapes of link {name!r} {read[name]} could be read"
        return f"{found}: {_cause(link)}"
    return None


def _cause(link: Element) -> str:
    elements = [*link.findall("collision"), *link.findall("visual")]
    for element in elements:
        tags = [shape.tag for shape in _shapes(element)]
        if not tags:
            return _of_all(f"it has a <{element.tag}> without a shape in its <geometry>")
        if tags[0] not in _SHAPES:
            known = ", ".join(_SHAPES)
            return _of_all(f"<{tags[0]}> is no known shape (known: {known})")
        if len(tags) > 1 and element.tag == "collision":
            return "give each shape a <collision> of its own"
    kinds = sorted({f"<{element.tag}>" for element in elements})
    return _of_all(
        f"correct its {' and '.join(kinds)} elements (sizes and places are numbers with single "
        "spaces between, a mesh has a filename, a material a name)"
    )


def _of_all(cause: str) -> str:
    return f"{cause}; one that cannot be read, and all of its link are left out"


def _shapes(element: Element) -> Iterator[Element]:
    for geometry in element.findall("geometry"):
        yield from geometry
