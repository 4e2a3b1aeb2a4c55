"""Where the elements of an XML text stand, so that some can be changed and no others.

An XML library that writes a tree again loses comments, the order and spacing of attributes, and
line ends. Here only the bytes of what changes are replaced.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple
from xml.parsers import expat
from xml.sax.saxutils import escape

from identification.errors import ModelError


def comment_text(text: str) -> str:
    """Return text that may stand inside a comment, which two dashes in a row would end."""
    return re.sub("-(?=-)", "- ", text)


@dataclass(eq=False)
class Element:
    """One element and where it stands in the UTF-8 text.

    Attributes:
        name: of the tag.
        attributes: as parsed.
        start: first byte of the opening tag.
        inside: first byte behind the opening tag.
        end: first byte behind the whole element.
        children: elements directly inside.
    """

    name: str
    attributes: dict[str, str]
    start: int
    inside: int
    end: int = -1
    children: list[Element] = field(default_factory=list)

    def child(self, name: str) -> Element | None:
        """Return the first child of that name."""
        return next((child for child in self.children if child.name == name), None)


class Edit(NamedTuple):
    """Replace the bytes from `start` to `end` (nothing, if equal) with `text`."""

    start: int
    end: int
    text: str


class XmlSource:
    """An XML text that can be edited in place.

    Args:
        text: the whole file.

    Attributes:
        root: its outermost element.

    Raises:
        ModelError: the text is not well-formed XML.
    """

    def __init__(self, text: str) -> None:
        self._bytes = text.encode("utf-8")
        self.root = self._parse()

    def opening(self, element: Element) -> str:
        """Return the opening tag, as written."""
        return self._bytes[element.start : element.inside].decode("utf-8")

    def indentation(self, element: Element) -> str:
        """Return the white space in front of an element that begins its line, else nothing."""
        before = self._bytes[: element.start].decode("utf-8")
        line = before[before.rfind("\n") + 1 :]
        return line if not line.strip() else ""

    @property
    def newline(self) -> str:
        """The text's line end."""
        return "\r\n" if b"\r\n" in self._bytes else "\n"

    def edited(self, edits: Iterable[Edit]) -> str:
        """Return the text with edits applied, which must not overlap."""
        data = self._bytes
        for edit in sorted(edits, reverse=True):
            data = data[: edit.start] + edit.text.encode("utf-8") + data[edit.end :]
        return data.decode("utf-8")

    def with_attributes(self, element: Element, values: dict[str, str]) -> Edit:
        """Return the edit that sets attributes; others, and their order, stay."""
        tag = self.opening(element)
        for name, value in values.items():
            written = f'"{escape(value, {chr(34): "&quot;"})}"'
            pattern = re.compile(rf"(\s{re.escape(name)}\s*=\s*)(\"[^\"]*\"|'[^']*')")
            if found := pattern.search(tag):
                tag = tag[: found.start(2)] + written + tag[found.end() :]
            else:
                at = re.search(r"\s*/?>$", tag)
                assert at is not None, "an opening tag ends so"
                tag = f"{tag[: at.start()]} {name}={written}{tag[at.start() :]}"
        return Edit(element.start, element.inside, tag)

    def with_first_child(self, element: Element, lines: list[str]) -> Edit:
        """Return the edit that puts lines of XML directly behind the opening tag."""
        outer = self.indentation(element)
        children = [self.indentation(child) for child in element.children]
        inner = next((indent for indent in children if indent), outer + "  ")
        block = "".join(f"{self.newline}{inner}{line}" for line in lines)
        tag = self.opening(element)
        if tag.endswith("/>"):
            opened = tag[:-2].rstrip() + ">"
            closing = f"{self.newline}{outer}</{element.name}>"
            return Edit(element.start, element.end, opened + block + closing)
        return Edit(element.inside, element.inside, block)

    def _parse(self) -> Element:
        parser = expat.ParserCreate("utf-8")
        open_elements: list[Element] = []
        roots: list[Element] = []

        def opened(name: str, attributes: dict[str, str]) -> None:
            start = parser.CurrentByteIndex
            element = Element(name, attributes, start, self._behind_tag(start))
            (open_elements[-1].children if open_elements else roots).append(element)
            open_elements.append(element)

        def closed(_: str) -> None:
            element = open_elements.pop()
            if self._bytes[element.inside - 2 : element.inside] == b"/>":
                element.end = element.inside
            else:
                element.end = self._bytes.index(b">", parser.CurrentByteIndex) + 1

        parser.StartElementHandler = opened
        parser.EndElementHandler = closed
        try:
            parser.Parse(self._bytes, True)
        except expat.ExpatError as error:
            raise ModelError(f"the robot description is no XML: {error}") from error
        return roots[0]

    def _behind_tag(self, start: int) -> int:
        """Return the first byte behind the tag that begins at `start`; values may contain '>'."""
        tag = re.compile(rb"<(?:[^>\"']|\"[^\"]*\"|'[^']*')*>").match(self._bytes, start)
        assert tag is not None, "the parser has seen a whole tag here"
        return tag.end()


def with_comment(text: str, lines: Sequence[str]) -> str:
    """Return an XML text with a comment of these lines in front of its first element.

    Raises:
        ModelError: the text is not well-formed XML.
    """
    source = XmlSource(text)
    inside = comment_text(source.newline.join(f"  {line}" for line in lines))
    comment = f"<!--{source.newline}{inside}{source.newline}-->{source.newline}"
    at = source.root.start
    return source.edited([Edit(at, at, comment)])
