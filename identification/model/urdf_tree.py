"""The elements of a robot description, as its readers in C++ take them.

To them a colon is a letter of a name as any other and `xmlns` an attribute without effect, where
most libraries for XML put the namespace before every name: a `<link>` that the model has would
not be found.
"""

from __future__ import annotations

from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from identification.errors import ModelError


def urdf_tree(urdf: str, *, comments: bool = False) -> Element:
    """Return the outermost element of URDF text; names are those written there.

    `xml.etree.ElementTree.tostring` gives a text with the same names again.

    Args:
        urdf: the text of the file; the encoding it may name counts no longer.
        comments: keep those inside the outermost element.

    Raises:
        ModelError: the text is not well-formed XML.
    """
    builder = TreeBuilder(insert_comments=comments)
    parser = expat.ParserCreate("utf-8")
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    if comments:
        parser.CommentHandler = builder.comment
    try:
        parser.Parse(urdf.encode(), True)
    except (expat.ExpatError, UnicodeEncodeError) as problem:
        raise ModelError(f"the robot description is no XML: {problem}") from problem
    root: Element = builder.close()
    return root
