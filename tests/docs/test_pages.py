"""What pages and findings name exists; the API reference names what packages export."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

import pytest

from identification.validation.finding_messages import SENTENCES
from tests.docs.typed import PAGES, ROOT, command_of, options
from tests.house import nodes_of

NAME = re.compile(r"`((?:hil|drivers|planner|identification|sim_fixtures)(?:\.\w+)+)(?:\(\))?`")
REFERENCE = ROOT / "docs" / "api.md"
RECORDS = {"hil.outcome"}  # metadata of an archive
FILES = ("py", "toml", "urdf", "mcap", "md", "json", "html", "dbc", "csv", "dot")


def found(name: str) -> object:
    """The module, or what it holds; LookupError if there is no such thing."""
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            thing: object = import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            if not hasattr(thing, part) and part not in getattr(thing, "__annotations__", {}):
                raise LookupError(name)
            thing = getattr(thing, part, None)
        return thing
    raise LookupError(name)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_name_of_the_packages_exists(page: Path) -> None:
    for name in set(NAME.findall(page.read_text("utf-8"))):
        if name.rpartition(".")[2] not in FILES and name not in RECORDS:
            found(name)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_every_link_to_a_file_leads_to_one(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text("utf-8")):
        if not target.startswith(("http:", "https:")):
            assert (page.parent / target).exists(), target


def test_every_page_is_in_the_table_of_contents() -> None:
    docs = ROOT / "docs"
    indexed = set()
    for block in re.findall(
        r"```{toctree}\n(.*?)```", (docs / "index.md").read_text("utf-8"), re.S
    ):
        indexed |= {line for line in block.splitlines() if line and line[0] != ":"}
    assert indexed == {page.stem for page in docs.glob("*.md")} - {"index"}


def test_the_api_reference_covers_the_public_faces() -> None:
    text = REFERENCE.read_text("utf-8")
    documented = set(re.findall(r"automodule:: (\S+)", text))
    assert documented >= {
        "hil.cell", "hil.campaign", "hil.pipeline.identification", "hil.batch.graph",
        "hil.testing.faulty", "drivers", "planner", "identification", "identification.excitation",
        "sim_fixtures",
    }  # fmt: skip
    for module in documented:
        import_module(module)


def test_the_reference_of_the_drivers_has_every_name() -> None:
    import drivers

    text = REFERENCE.read_text("utf-8").partition("### drivers:")[2]
    documented = re.findall(
        r"^\.\. auto(?:class|exception|function|data):: (?:[\w.]+\.)?(\w+)$", text, re.M
    )
    assert sorted(documented) == sorted(drivers.__all__)


def test_the_page_on_verdicts_explains_every_finding() -> None:
    """A row for each check, with what is seen, the cause and the remedy."""
    page = (ROOT / "docs" / "read-a-report.md").read_text("utf-8")
    explained = {
        name
        for row in re.findall(r"^\| (`.*?) \| .* \| .* \| .+ \|$", page, re.M)
        for name in re.findall(r"`([^`]+)`", row)
    }
    checks = {sentence.check for sentence in SENTENCES.values()} - {"{change:check}"}
    assert explained == checks


FINDINGS = sorted((ROOT / "identification" / "validation").rglob("*.py"))
COMMAND = re.compile(r"`hil ([^`]+)`")


def sentences(module: Path) -> Iterator[str]:
    """The strings of a module; a figure in one of them is an X."""
    for node in nodes_of(module):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(getattr(part, "value", "X")) for part in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_commands_that_findings_recommend_exist() -> None:
    """With their options."""
    named = []
    for text in (text for module in FINDINGS for text in sentences(module)):
        assert {*re.findall(r"--[a-z][a-z-]+", COMMAND.sub("", text))} <= options()
        named += COMMAND.findall(text)
    assert named
    for line in named:
        command, arguments = command_of(line.split())
        known_options = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in arguments if word.startswith("-")} <= known_options, line


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The pages, built without a warning."""
    folder = tmp_path_factory.mktemp("pages")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-q", "-W", str(ROOT / "docs"), str(folder)],
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.slow
class TestBuilt:
    def test_the_pages_need_no_network(self, built: Path) -> None:
        needs = re.compile(r'<(?:script|link|img)[^>]*(?:src|href)="(?:https?:)?//[^"]*"')
        for page in built.rglob("*.html"):
            assert not needs.findall(page.read_text("utf-8")), page.name
        elsewhere = re.compile(r"url\(\s*['\"]?(?:https?:)?//")
        for sheet in built.rglob("*.css"):
            assert not elsewhere.search(sheet.read_text("utf-8")), sheet.name

    def test_the_reference_has_every_public_name(self, built: Path) -> None:
        import identification
        import planner

        page = (built / "api.html").read_text("utf-8")
        for package in (planner, identification):
            missing = [
                name for name in package.__all__ if f'id="{package.__name__}.{name}"' not in page
            ]
            assert not missing
