"""What a robot description must keep to before its readers see it: it may be anybody's file.

Readers written in C++ end the process on some texts, take minutes for others, and leave out the
inertia of a link where they cannot read one number of it.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Final
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from identification.errors import ModelError


# The elements of a robot description, as its readers in C++ take them.
#
# To them a colon is a letter of a name as any other and `xmlns` an attribute without effect,
# where most libraries for XML put the namespace before every name: a `<link>` that the model has
# would not be found.
def urdf_tree(urdf: str, *, comments: bool = False) -> Element:
    """Return the outermost element of URDF text, with comments if wanted; names are those written.

    `xml.etree.ElementTree.tostring` gives a text with the same names again; the encoding that the
    text may name counts no longer.

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


LONGEST: Final = 20_000_000
"""Characters of the longest description that is read; one of a whole cell has some 100 000."""
MOST_LINKS: Final = 1000
"""A chain of some thousands overflows the stack of the reader, which ends the process."""
XACRO: Final = "it is a xacro file; expand it with: xacro FILE > robot.urdf"
_DEEPEST: Final = 50  # a description needs seven
_MOST_ATTRIBUTES: Final = 100  # of one element; the reader's time grows with their square

_NUMBERS: Final[Mapping[str, Mapping[str, int]]] = {
    "origin": {"xyz": 3, "rpy": 3},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
}
"""How many numbers there are in the attributes of what an <inertial> holds."""
# As the reader takes them: it knows no blanks but spaces, and none behind a single number.
_NUMBER: Final = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_FORMS: Final = {
    1: re.compile(rf" *{_NUMBER}"),
    3: re.compile(rf" *{_NUMBER} +{_NUMBER} +{_NUMBER} *"),
}
_TAG: Final = re.compile(rb"""<[^"'>]*(?:(?:"[^"]*"|'[^']*')[^"'>]*)*>""")
_QUOTED: Final = re.compile(rb""""[^"]*"|'[^']*'""")
_BLANKS: Final = (b"\t", b"\n", b"\r")
"""XML makes spaces of them in attributes; the reader does not."""
_USUAL: Final = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
"""What a description means that leaves it out."""
_UNBOUND: Final = expat.errors.codes[expat.errors.XML_ERROR_UNBOUND_PREFIX]


class _RefusedError(Exception):
    """The description is refused; its argument says why."""


def refusal(text: str) -> str | None:
    """Return why a robot description is given to no reader, in words; None if it may be.

    It must be XML without entities of its own, which readers expand differently or without end;
    of a size, depth and number of links that readers bear; its links and joints must have names
    that can be printed; and an inertia must have all its numbers, each of which must be one.
    """
    if len(text) > LONGEST:
        return f"it has {len(text)} characters; at most {LONGEST} are read"
    found = _Reading()
    try:
        found.read(text)
    except _RefusedError as refused:
        return str(refused)
    except UnicodeEncodeError as problem:
        return f"it is no text ({problem.reason})"
    except expat.ExpatError as problem:
        return f"it is no XML ({problem})"
    return None


def left_by_xacro(tag: str, attributes: Mapping[str, str]) -> bool:
    """Whether an element is one that expanding a xacro file would have replaced."""
    return tag.startswith("xacro:") or any(
        mark in value for value in attributes.values() for mark in ("${", "$(")
    )


class _Reading:
    """One way through the elements."""

    def __init__(self) -> None:
        self._path: list[str] = []
        self._link = ""
        self._links = 0
        self._inertial: set[str] = set()  # the elements of the one that is open
        self._fault = ""  # the first of an inertia
        self._data = b""
        # The text was decoded: whatever encoding it says it has, it has no longer.
        self._parser = expat.ParserCreate("utf-8")
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._end
        self._parser.EntityDeclHandler = self._entity
        self._parser.StartDoctypeDeclHandler = self._doctype

    def read(self, text: str) -> None:
        """Go through all of it."""
        self._data = text.encode()
        try:
            self._parser.Parse(self._data, True)
        finally:
            del self._parser  # it knows this object: both would wait for the cycle collector
        if self._fault:
            unexpanded = any(left_by_xacro(e.tag, e.attrib) for e in urdf_tree(text).iter())
            raise _RefusedError(XACRO if unexpanded else self._fault)
        self._require_prefixes()

    def _require_prefixes(self) -> None:
        """Some readers take colons for namespaces, and refuse names that others take."""
        try:
            expat.ParserCreate("utf-8", "}").Parse(self._data, True)
        except expat.ExpatError as problem:
            if problem.code != _UNBOUND:
                raise
            raise _RefusedError(
                f"a name in line {problem.lineno} has a prefix that is declared nowhere; declare "
                'it, as in <robot xmlns:PREFIX="...">, or take out what has it'
            ) from problem

    def _doctype(self, _: str, system: str | None, *__: object) -> None:
        if system is not None:
            raise _RefusedError(
                f"its <!DOCTYPE> is described in {system[:40]!r}, which is not read; take it out"
            )

    def _entity(self, name: str, *_: object) -> None:
        raise _RefusedError(f"it declares the entity {name!r}; write its text where it is used")

    def _begin(self, tag: str, attributes: Mapping[str, str]) -> None:
        self._path.append(tag)
        if len(self._path) > _DEEPEST:
            raise _RefusedError(f"its elements are nested more than {_DEEPEST} deep")
        if len(attributes) > _MOST_ATTRIBUTES:
            raise _RefusedError(f"its <{tag[:40]}> has more than {_MOST_ATTRIBUTES} attributes")
        if len(self._path) == 2 and tag in ("link", "joint"):
            self._named(tag, attributes.get("name", ""))
        elif self._path[1:] == ["link", "inertial"]:
            self._inertial = set()
        elif self._path[1:] == ["link", "inertial", tag] and tag in _NUMBERS:
            self._inertial.add(tag)
            self._fault = self._fault or self._of_inertia(tag, attributes)

    def _end(self, _: str) -> None:
        if self._path[1:] == ["link", "inertial"]:
            for tag in ("mass", "inertia"):
                if tag not in self._inertial:
                    self._fault = self._fault or (
                        f"link {self._link!r} has no <{tag}> in its <inertial>; write one, or "
                        "leave the <inertial> out"
                    )
        self._path.pop()

    def _named(self, tag: str, name: str) -> None:
        if not name.isprintable():
            raise _RefusedError(f"the name of {tag} {name!r} has characters that cannot be printed")
        if self._has_blanks():
            raise _RefusedError(
                f"{tag} {name!r} has a tab or line end within its name or type; put a space there"
            )
        if tag == "link":
            self._link = name
            self._links += 1
            if self._links > MOST_LINKS:
                raise _RefusedError(f"it has more than {MOST_LINKS} links")

    def _of_inertia(self, tag: str, attributes: Mapping[str, str]) -> str:
        place = f"in the <{tag}> of its <inertial>"
        needed = [] if tag == "origin" else [key for key in _NUMBERS[tag] if key not in attributes]
        if needed:
            written = " ".join(f'{key}="{_USUAL.get(key, "...")}"' for key in needed)
            return f"link {self._link!r} has no {', '.join(needed)} {place}; write {written}"
        for key, count in _NUMBERS[tag].items():
            text = attributes.get(key)
            if text is not None and not (_FORMS[count].fullmatch(text) and _finite(text)):
                shown = text if len(text) <= 40 else f"{text[:40]}..."
                wanted = "one number" if count == 1 else f"{count} numbers"
                return (
                    f"link {self._link!r} has {key}={shown!r} {place}; "
                    f"write {wanted}, with nothing before or behind"
                )
        if tag == "mass" and (mass := float(attributes["value"])) < 0.0:
            return f"link {self._link!r} has a mass of {mass:g} kg; write 0 or more"
        if self._has_blanks():
            return (
                f"link {self._link!r} has a tab or line end within an attribute of the <{tag}> of "
                "its <inertial>; put spaces there"
            )
        return ""

    def _has_blanks(self) -> bool:
        """Whether an attribute of the element that begins has some that only XML takes as such."""
        written = _TAG.match(self._data, self._parser.CurrentByteIndex)
        values = [] if written is None else _QUOTED.findall(written[0])
        return any(blank in value for value in values for blank in _BLANKS)


def _finite(text: str) -> bool:
    return all(math.isfinite(float(word)) for word in text.split())
