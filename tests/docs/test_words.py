"""Words that people read are those of robotics, control and Python."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.docs.sources import MODULES, docstrings
from tests.docs.typed import PAGES, ROOT
from tests.house import PACKAGES, nodes_of

TEMPLATES = sorted((ROOT / "hil" / "report" / "templates").glob("*.j2"))
IDIOMS = re.compile(
    r"\b(kept|told|taken|announced|standing|wish|wish(es|ed)|doubts?|strangers?|sight|ways|plain"
    r"|what it carries|against a constant|turning round|hardly told|gone on with"
    r"|nobody counted|counted alike|taken as read|anew|mishaps?|hopeless|mended|somebody|far end"
    r"|go on|goes on|went on|gone on|carried on|gives up|comes to its end)\b",
    re.IGNORECASE,
)
NEVER = re.compile(r"\b(told|wish|wish(es|ed)|doubts?|strangers?|sight|announced)\b", re.IGNORECASE)
LITERAL = {
    "text/plain": "media type of an attachment",
    "plain": "name of the rehearsal and the study without unmodelled effects, and of their folders",
    "doubts": "key of files that earlier versions wrote",
}
INDEX = re.compile(r"\bpypi\b|\bconda\b|\bnpm\b|https?://\S*/simple\b", re.IGNORECASE)
MOST_TERMS = 72


@cache
def texts(module: Path) -> tuple[tuple[int, str, bool], ...]:
    """Line and value of each string, and whether it is a docstring."""
    inner = docstrings(module)
    return tuple(
        (node.lineno, node.value, node in inner)
        for node in nodes_of(module)
        if isinstance(node, ast.Constant) and isinstance(node.value, str)
    )


def prose(page: Path) -> Iterator[tuple[int, str]]:
    """Lines of a page without code; fenced blocks are emptied."""
    fenced = False
    for number, line in enumerate(page.read_text("utf-8").splitlines(), 1):
        fence = line.lstrip().startswith("```")
        fenced ^= fence
        if not (fence or fenced):
            yield number, re.sub(r"`[^`]*`", "", line)


def found(where: Path, lines: Iterator[tuple[int, str]], pattern: re.Pattern[str]) -> list[str]:
    name = where.relative_to(ROOT)
    return [f"{name}:{k}: {text[:80]!r}" for k, text in lines if pattern.search(text)]


class TestWords:
    def test_messages_have_no_idioms(self) -> None:
        """Each string that is no docstring; `LITERAL` has the exceptions."""
        wrong: list[str] = []
        for module in MODULES:
            literals = ((k, text) for k, text, inner in texts(module) if not inner)
            wrong += found(
                module, ((k, text) for k, text in literals if text not in LITERAL), IDIOMS
            )
        assert not wrong, "\n".join(wrong)

    def test_docstrings_have_none_of_the_worst(self) -> None:
        wrong: list[str] = []
        for module in MODULES:
            wrong += found(module, ((k, t) for k, t, inner in texts(module) if inner), NEVER)
        assert not wrong, "\n".join(wrong)

    @pytest.mark.parametrize("page", [*PAGES, *TEMPLATES], ids=lambda page: page.name)
    def test_pages_have_no_idioms(self, page: Path) -> None:
        wrong = found(page, prose(page), IDIOMS)
        assert not wrong, "\n".join(wrong)

    @pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
    def test_pages_have_no_address_of_a_package_index(self, page: Path) -> None:
        """A package is named; where it comes from is the reader's choice."""
        assert not INDEX.search(page.read_text("utf-8"))


def fields_with_percent(module: Path) -> Iterator[ast.FormattedValue]:
    """Fields of f-strings with a per cent sign at once behind the number."""
    for text in (node for node in nodes_of(module) if isinstance(node, ast.JoinedStr)):
        for part, after in zip(text.values, [*text.values[1:], None], strict=True):
            if isinstance(part, ast.FormattedValue):
                spec = ast.unparse(part.format_spec) if part.format_spec is not None else ""
                is_sign = isinstance(after, ast.Constant) and str(after.value).startswith("%")
                if is_sign or spec.rstrip("'\"").endswith("%"):
                    yield part


class TestPercentages:
    @pytest.mark.parametrize("package", PACKAGES)
    def test_messages_have_a_space_before_the_sign(self, package: str) -> None:
        wrong: list[str] = []
        for module in (path for path in MODULES if path.is_relative_to(ROOT / package)):
            wrong += [f"{module}:{field.lineno}" for field in fields_with_percent(module)]
            literals = ((k, text) for k, text, inner in texts(module) if not inner)
            wrong += found(module, literals, re.compile(r"[^.{}]\d%(?!})|\{[^{}]*%\}"))
        assert not wrong, "use identification.text.percentage:\n" + "\n".join(wrong)

    @pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
    def test_pages_have_one_too(self, page: Path) -> None:
        lines = enumerate(page.read_text("utf-8").splitlines(), 1)
        wrong = found(page, iter(lines), re.compile(r"\d%(?!\w)"))
        assert not wrong, "\n".join(wrong)


class TestUnits:
    """Products of units have a dot at half height; column maps have the names in `UNITS`."""

    WRONG = re.compile(r"\bN\.m\b|\bNm\b|\bN m\b|\bkg\.?m\b|\bkg m(?!\w)")
    DEFINED = ("importers/units.py", "archive/schema.py", "precision/requirements.py")

    def test_messages_have_a_dot_between(self) -> None:
        wrong: list[str] = []
        for module in (path for path in MODULES if not str(path).endswith(self.DEFINED)):
            literals = ((k, text) for k, text, inner in texts(module) if not inner)
            wrong += found(module, literals, self.WRONG)
        assert not wrong, "\n".join(wrong)


class TestGlossary:
    def test_is_one_page_in_alphabetical_order(self) -> None:
        rows = (ROOT / "docs" / "glossary.md").read_text("utf-8").split("|---|---|\n")[1]
        terms = [row.split("|")[1].strip() for row in rows.strip().splitlines()]
        assert terms == sorted(terms, key=str.lower)
        assert len(terms) == len(set(terms)) <= MOST_TERMS
