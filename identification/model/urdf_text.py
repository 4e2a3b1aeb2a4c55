"""Checks of untrusted URDF text, on which pinocchio's reader may crash or ignore inertias."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from typing import Final
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from identification.errors import ModelError


def urdf_tree(urdf: str, *, comments: bool = False) -> Element:
    """Return the root element of URDF text; like pinocchio, ignore namespaces and encoding.

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
        raise ModelError(f"the robot description is not XML: {problem}") from problem
    root: Element = builder.close()
    return root


def position_units(urdf: str, joints: Iterable[str]) -> dict[str, str]:
    """Return the unit of the position of joints by name: rad, or m of prismatic joints."""
    kinds = {joint.get("name"): joint.get("type") for joint in urdf_tree(urdf).findall("joint")}
    return {name: "m" if kinds[name] == "prismatic" else "rad" for name in joints}


MAX_CHARACTERS: Final = 20_000_000
"""Largest number of characters; the description of a cell has some 100 000."""
MAX_LINKS: Final = 1000
"""Largest number of links; a chain of some thousands overflows the reader's stack."""
XACRO: Final = "it is a xacro file; expand it with: xacro FILE > robot.urdf"
_MAX_NESTING_DEPTH: Final = 50  # a description needs seven
_MAX_ATTRIBUTES: Final = 100  # of one element; the reader's time grows with their square

_NUMBERS: Final[Mapping[str, Mapping[str, int]]] = {
    "origin": {"xyz": 3, "rpy": 3},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
}
"""Numbers in the attributes of the elements of an <inertial>."""
# As the reader accepts them: spaces only, and none after a single number.
_NUMBER: Final = r"[+-]?(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:[eE][+-]?[0-9]+)?"
_FORMS: Final = {
    1: re.compile(rf" *{_NUMBER}"),
    3: re.compile(rf" *{_NUMBER} +{_NUMBER} +{_NUMBER} *"),
}
_TAG: Final = re.compile(rb"""<[^"'>]*(?:(?:"[^"]*"|'[^']*')[^"'>]*)*>""")
_QUOTED: Final = re.compile(rb""""[^"]*"|'[^']*'""")
_BLANKS: Final = (b"\t", b"\n", b"\r")  # spaces in attributes for XML, but not for the reader
_DEFAULT_PRODUCTS: Final = dict.fromkeys(("ixy", "ixz", "iyz"), "0")
_UNBOUND_PREFIX_MESSAGE: Final = expat.errors.codes[expat.errors.XML_ERROR_UNBOUND_PREFIX]


class _RefusedError(Exception):
    """The description is refused, with a reason."""


def refusal(text: str) -> str | None:
    """Return why a robot description is not read, None if it is valid.

    It must be XML of limited size, depth and number of links, without entities, with printable
    names, and with complete, finite inertias.
    """
    if len(text) > MAX_CHARACTERS:
        return f"it has {len(text)} characters; at most {MAX_CHARACTERS} are read"
    reading = _Reading()
    try:
        reading.read(text)
    except _RefusedError as refused:
        return str(refused)
    except UnicodeEncodeError as problem:
        return f"it is not text ({problem.reason})"
    except expat.ExpatError as problem:
        return f"it is not XML ({problem})"
    return None


def left_by_xacro(tag: str, attributes: Mapping[str, str]) -> bool:
    """Whether an element is part of an unexpanded xacro file."""
    return tag.startswith("xacro:") or any(
        mark in value for value in attributes.values() for mark in ("${", "$(")
    )


class _Reading:
    """Checks during one pass through the elements."""

    def __init__(self) -> None:
        self._path: list[str] = []
        self._link = ""
        self._links = 0
        self._inertial: set[str] = set()  # elements of the current <inertial>
        self._fault = ""  # the first one in an <inertial>
        self._data = b""
        self._parser = expat.ParserCreate("utf-8")  # whatever encoding the text declares
        self._parser.StartElementHandler = self._begin
        self._parser.EndElementHandler = self._end
        self._parser.EntityDeclHandler = self._entity
        self._parser.StartDoctypeDeclHandler = self._doctype

    def read(self, text: str) -> None:
        """Parse a text (_RefusedError, or expat.ExpatError if it is not XML)."""
        self._data = text.encode()
        try:
            self._parser.Parse(self._data, True)
        finally:
            del self._parser  # a reference cycle
        if self._fault:
            unexpanded = any(left_by_xacro(e.tag, e.attrib) for e in urdf_tree(text).iter())
            raise _RefusedError(XACRO if unexpanded else self._fault)
        self._require_prefixes()

    def _require_prefixes(self) -> None:
        """Check that prefixes of names are declared, which readers with namespaces require."""
        try:
            expat.ParserCreate("utf-8", "}").Parse(self._data, True)
        except expat.ExpatError as problem:
            if problem.code != _UNBOUND_PREFIX_MESSAGE:
                raise
            raise _RefusedError(
                f"a name in line {problem.lineno} has an undeclared prefix; declare it, as in "
                '<robot xmlns:PREFIX="...">, or remove the element or attribute'
            ) from problem

    def _doctype(self, _: str, system: str | None, *__: object) -> None:
        if system is not None:
            raise _RefusedError(
                f"its <!DOCTYPE> refers to {system[:40]!r}, which is not read; remove it"
            )

    def _entity(self, name: str, *_: object) -> None:
        raise _RefusedError(f"it declares the entity {name!r}; write its text where it is used")

    def _begin(self, tag: str, attributes: Mapping[str, str]) -> None:
        self._path.append(tag)
        if len(self._path) > _MAX_NESTING_DEPTH:
            raise _RefusedError(f"its elements are nested more than {_MAX_NESTING_DEPTH} deep")
        if len(attributes) > _MAX_ATTRIBUTES:
            raise _RefusedError(f"its <{tag[:40]}> has more than {_MAX_ATTRIBUTES} attributes")
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
                f"{tag} {name!r} has a tab or line end in its name or type; put a space there"
            )
        if tag == "link":
            self._link = name
            self._links += 1
            if self._links > MAX_LINKS:
                raise _RefusedError(f"it has more than {MAX_LINKS} links")

    def _of_inertia(self, tag: str, attributes: Mapping[str, str]) -> str:
        where = f"in the <{tag}> of its <inertial>"
        needed = [] if tag == "origin" else [key for key in _NUMBERS[tag] if key not in attributes]
        if needed:
            written = " ".join(f'{key}="{_DEFAULT_PRODUCTS.get(key, "...")}"' for key in needed)
            return f"link {self._link!r} has no {', '.join(needed)} {where}; write {written}"
        for key, count in _NUMBERS[tag].items():
            text = attributes.get(key)
            if text is not None and not (_FORMS[count].fullmatch(text) and _finite(text)):
                expected = "one number" if count == 1 else f"{count} numbers"
                return f"link {self._link!r} has {key}={text[:40]!r} {where}; write only {expected}"
        if tag == "mass" and (mass := float(attributes["value"])) < 0.0:
            return f"link {self._link!r} has a mass of {mass:g} kg; write 0 or more"
        if self._has_blanks():
            return (
                f"link {self._link!r} has a tab or line end in an attribute of the <{tag}> of "
                "its <inertial>; put spaces there"
            )
        return ""

    def _has_blanks(self) -> bool:
        """Whether an attribute of the current element has blanks that the reader rejects."""
        written = _TAG.match(self._data, self._parser.CurrentByteIndex)
        values = [] if written is None else _QUOTED.findall(written[0])
        return any(blank in value for value in values for blank in _BLANKS)


def _finite(text: str) -> bool:
    return all(math.isfinite(float(word)) for word in text.split())
