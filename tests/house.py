"""Order of the source code, held at its ceilings, and its size, as information.

Run with ``python -m tests.house [--list NAME]``; NAME is a row of the table with a ceiling.
"""

from __future__ import annotations

import argparse
import ast
import gc
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
PACKAGES: Final = ("drivers", "planner", "identification", "sim_fixtures", "hil")
CEILINGS: Final[Mapping[str, int]] = {
    "import circles": 0,
    "folder circles": 0,
    "imports inside functions": 16,
    "banned names": 0,
    "functions over 60 lines": 4,
    "motions taken apart": 0,
    "array types defined twice": 0,
    "long names of tests": 0,
    "tests of hil outside a room": 0,
    "class names defined twice": 0,
    "helpers of other test modules": 0,
    "long signatures without Args": 0,
}
"""Figures that no change may exceed. Size has none: features are not traded for lines."""
BANNED: Final = {
    *("kept", "told", "taken", "answers", "announced", "standing", "sight", "wish", "doubts"),
    *("strangers", "plain", "ways", "drawn", "listed", "counted", "settling"),
    *("anew", "mishap", "mishaps", "hopeless", "mend", "mended", "trouble", "troubles", "suffer"),
}
_STATES: Final = {"q", "qd", "qdd"}
_WITHOUT_MOTION: Final = ("planner", "drivers", "sim_fixtures")  # they may not import it
_ALIASES: Final = {f"{package}.arrays" for package in PACKAGES} | {"hil.base.arrays"}
_LONG: Final = 60  # Lines of a function, characters of a test's name
_MANY: Final = 4  # Parameters of a signature that needs a word on each


@cache
def tree_of(module: Path) -> ast.Module:
    """Syntax tree of a module, parsed once for all tests of a process."""
    with _no_collection():
        return ast.parse(module.read_text("utf-8"))


@cache
def nodes_of(module: Path) -> tuple[ast.AST, ...]:
    """All nodes of a module, likewise."""
    with _no_collection():
        return tuple(_walk(tree_of(module)))


def _walk(tree: ast.AST) -> list[ast.AST]:
    """All nodes as of `ast.walk`, without contexts such as `ast.Load`: twice as fast."""
    nodes = [tree]
    for node in nodes:  # it grows
        for name in node._fields:
            value = getattr(node, name, None)
            if isinstance(value, list):
                nodes += [each for each in value if isinstance(each, ast.AST)]
            elif isinstance(value, ast.AST) and not isinstance(value, ast.expr_context):
                nodes.append(value)
    return nodes


@contextmanager
def _no_collection() -> Iterator[None]:
    """Pause the garbage collector: it took half of the time, and trees are no garbage."""
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


@dataclass(frozen=True)
class Sources:
    """Python files of the five packages by module name."""

    files: Mapping[str, Path]

    @classmethod
    def read(cls) -> Sources:
        """Those of this checkout."""
        files = {}
        for package in PACKAGES:
            for path in sorted((ROOT / package).rglob("*.py")):
                name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
                files[name.removesuffix(".__init__")] = path
        return cls(files)

    @cached_property
    def trees(self) -> dict[str, ast.Module]:
        """Syntax tree of each module."""
        return {name: tree_of(path) for name, path in self.files.items()}

    @cached_property
    def nodes(self) -> dict[str, tuple[ast.AST, ...]]:
        """All nodes of each module."""
        return {name: nodes_of(path) for name, path in self.files.items()}

    @cached_property
    def imports(self) -> dict[str, set[str]]:
        """Modules of ours that each module imports when it is loaded, or for its types."""
        return {
            name: {
                target
                for node in _loaded(tree)
                for target in self._targets(name, node)
                if target != name
            }
            for name, tree in self.trees.items()
        }

    def _targets(self, name: str, node: ast.AST) -> Iterator[str]:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in self.files)
        elif isinstance(node, ast.ImportFrom):
            base = node.module or ""
            if node.level:
                name_parts = name.split(".")
                package = self.files[name].name == "__init__.py"
                parents = name_parts[: len(name_parts) - node.level + package]
                base = ".".join([*parents, *([base] if base else [])])
            for alias in node.names:
                whole = f"{base}.{alias.name}"
                if whole in self.files:
                    yield whole
                elif base in self.files:
                    yield base

    def circles(self) -> list[str]:
        """Modules that import one another, as a way round; one circle at most."""
        return _circle(self.imports)

    def folder_circles(self) -> list[str]:
        """Folders that import one another, as a way round; one circle at most in each package.

        In each package, its files and folders are compared, a folder with all that is below it. An
        `__init__`, which lists the names of its package, belongs to none.
        """
        graphs: dict[str, dict[str, set[str]]] = {}
        for name, targets in self.imports.items():
            for target in targets:
                package, importing, imported = _siblings(name, target)
                if importing and imported:
                    graphs.setdefault(package, {}).setdefault(importing, set()).add(imported)
        return [circle for graph in graphs.values() for circle in _circle(graph)]

    def inner_imports(self) -> list[str]:
        """Imports of ours inside functions."""
        return [
            f"{name}:{node.lineno} {target}"
            for name, nodes in self.nodes.items()
            for node in _imports(nodes) - _imports(_loaded(self.trees[name]))
            for target in self._targets(name, node)
        ]

    def single_importers(self) -> list[str]:
        """Modules that one other module imports, in the same folder."""
        users: dict[str, set[str]] = {name: set() for name in self.files}
        for name, targets in self.imports.items():
            for target in targets:
                users[target].add(name)
        return [
            f"{name} <- {user}"
            for name, (user,) in ((n, tuple(u)) for n, u in users.items() if len(u) == 1)
            if user.rpartition(".")[0] == name.rpartition(".")[0]
        ]

    def banned_names(self) -> list[str]:
        """Modules, functions, classes, arguments and variables with an idiom for a name."""
        banned = []
        for name, nodes in self.nodes.items():
            names = [(1, name.rpartition(".")[2])]
            for node in nodes:
                if isinstance(node, ast.FunctionDef | ast.ClassDef | ast.AsyncFunctionDef):
                    names.append((node.lineno, node.name))
                elif isinstance(node, ast.arg):
                    names.append((node.lineno, node.arg))
                elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    names.append((node.lineno, node.id))
            banned += [
                f"{name}:{line} {identifier}"
                for line, identifier in names
                if BANNED.intersection(re.findall("[a-z]+", identifier.lower()))
            ]
        return banned

    def motions_taken_apart(self) -> list[str]:
        """Slices of a motion, and functions with a row of its arrays as parameters."""
        apart = []
        for name, nodes in self.nodes.items():
            if name.split(".")[0] in _WITHOUT_MOTION:
                continue
            for node in nodes:
                if isinstance(node, ast.Subscript) and isinstance(node.slice, ast.Slice):
                    whole = ast.unparse(node.value)
                    if whole.rpartition(".")[2] == "motion":
                        apart.append(f"{name}:{node.lineno} {ast.unparse(node)}")
                elif isinstance(node, ast.arguments):
                    names = [given.arg for given in (*node.posonlyargs, *node.args)]
                    if _STATES.issubset(names):
                        apart.append(f"{name} {', '.join(names)}")
        return apart

    def second_array_types(self) -> list[str]:
        """Definitions of `Array` outside the module of a package that has it."""
        return [
            f"{name}:{node.lineno}"
            for name, nodes in self.nodes.items()
            if name not in _ALIASES
            for node in nodes
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id == "Array"
        ]

    def second_classes(self) -> list[str]:
        """Public classes of a name that several modules define, one entry for each name."""
        places: dict[str, list[str]] = {}
        for name, nodes in self.nodes.items():
            for node in nodes:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    places.setdefault(node.name, []).append(name)
        return [
            f"{name}: {', '.join(modules)}"
            for name, modules in sorted(places.items())
            if len(modules) > 1
        ]

    def undescribed_parameters(self) -> list[str]:
        """Public functions and methods of `_MANY` parameters or more without a block `Args:`.

        One that says "See `...`" has the parameters of what it names; the options of a command
        have their help, and the parameters of a fixture are fixtures.
        """
        return [
            f"{name}:{node.lineno} {node.name}, {count} parameters"
            for name, tree in self.trees.items()
            if not name.startswith("hil.cli.")
            for node in _public_functions(tree)
            if (count := _parameters(node)) >= _MANY
            and not any("fixture" in ast.unparse(each) for each in node.decorator_list)
            and "Args:" not in (text := ast.get_docstring(node) or "")
            and not text.startswith("See ")
        ]

    def long_functions(self) -> list[str]:
        """Functions of more lines than `_LONG`, docstring left out."""
        return [
            f"{name}:{node.lineno} {node.name}, {count} lines"
            for name, nodes in self.nodes.items()
            for node in nodes
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
            and (count := _code_lines(node)) > _LONG
        ]


def long_test_names() -> list[str]:
    """Names of tests of more than `_LONG` characters."""
    return [
        name
        for path in _tests()
        for name in re.findall(r"def (test_\w+)", path.read_text("utf-8"))
        if len(name) > _LONG
    ]


def tests_outside_a_room() -> list[str]:
    """Tests below tests/hil that are in no folder named after a folder of hil."""
    here = ROOT / "tests" / "hil"
    below = [path.relative_to(here) for path in here.rglob("test_*.py")]
    return [
        str(path)
        for path in sorted(below)
        if len(path.parts) < 2 or not (ROOT / "hil" / path.parts[0]).is_dir()
    ]


def helpers_of_other_tests() -> list[str]:
    """Names that a file of the tests imports from a module of tests."""
    return [
        f"{path.relative_to(ROOT)}:{node.lineno} {node.module}: {alias.name}"
        for path in _tests()
        if re.search(r"^\s*from\s+tests[\w.]*\.test_", path.read_text("utf-8"), re.MULTILINE)
        for node in nodes_of(path)
        if isinstance(node, ast.ImportFrom)
        and (node.module or "").startswith("tests.")
        and (node.module or "").rpartition(".")[2].startswith("test_")
        for alias in node.names
    ]


def _circle(graph: Mapping[str, set[str]]) -> list[str]:
    """A way round in a graph of imports; empty without one."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return [", ".join(error.args[1])]
    return []


def _siblings(name: str, target: str) -> tuple[str, str, str]:
    """The package that two modules share, and its file or folder with each; "" for itself."""
    first = name.split(".")
    second = target.split(".")
    depth = next(
        (k for k, (a, b) in enumerate(zip(first, second, strict=False)) if a != b),
        min(len(first), len(second)),
    )
    package = ".".join(first[:depth])
    return package, ".".join(first[depth : depth + 1]), ".".join(second[depth : depth + 1])


def _imports(nodes: Iterable[ast.AST]) -> set[ast.Import | ast.ImportFrom]:
    return {node for node in nodes if isinstance(node, ast.Import | ast.ImportFrom)}


def _public_functions(tree: ast.AST) -> Iterator[ast.FunctionDef | ast.AsyncFunctionDef]:
    """Public functions of a module, and public methods of its public classes."""
    for node in ast.iter_child_nodes(tree):
        name = getattr(node, "name", "")
        if name.startswith("_"):
            continue
        if isinstance(node, ast.ClassDef):
            yield from _public_functions(node)
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node


def _code_lines(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Lines of a function without its docstring."""
    count = (node.end_lineno or node.lineno) - node.lineno + 1
    text = node.body[0]
    if ast.get_docstring(node) is None:
        return count
    return count - ((text.end_lineno or text.lineno) - text.lineno + 1)


def _parameters(node: ast.FunctionDef | ast.AsyncFunctionDef) -> int:
    """Number of parameters, `self` and `cls` left out."""
    given = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
    return sum(argument.arg not in ("self", "cls") for argument in given)


def _loaded(tree: ast.AST) -> Iterator[ast.AST]:
    """Nodes outside functions; imports for types alone, which do not run, are among them."""
    for node in ast.iter_child_nodes(tree):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            yield node
            yield from _loaded(node)


def lists(sources: Sources) -> dict[str, list[str]]:
    """Each row of the table that has a ceiling, in full."""
    return {
        "import circles": sources.circles(),
        "folder circles": sources.folder_circles(),
        "imports inside functions": sources.inner_imports(),
        "banned names": sources.banned_names(),
        "functions over 60 lines": sources.long_functions(),
        "motions taken apart": sources.motions_taken_apart(),
        "array types defined twice": sources.second_array_types(),
        "long names of tests": long_test_names(),
        "tests of hil outside a room": tests_outside_a_room(),
        "class names defined twice": sources.second_classes(),
        "helpers of other test modules": helpers_of_other_tests(),
        "long signatures without Args": sources.undescribed_parameters(),
    }


def figures(sources: Sources) -> dict[str, int]:
    """The rows that have a ceiling."""
    return {name: len(entries) for name, entries in lists(sources).items()}


def statements(tree: ast.AST) -> int:
    """Number of statements, docstrings left out."""
    return sum(
        isinstance(node, ast.stmt)
        and not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant))
        for node in ast.walk(tree)
    )


def sizes(sources: Sources) -> dict[str, int]:
    """Size of the packages and of the tests, as information."""
    trees = {
        package: [tree for name, tree in sources.trees.items() if name.split(".")[0] == package]
        for package in PACKAGES
    }
    trees["tests"] = [tree_of(path) for path in _tests()]
    table = {f"statements of {name}": sum(map(statements, some)) for name, some in trees.items()}
    classes = [
        node
        for tree in sources.trees.values()
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
    ]
    errors = [node for node in classes if node.name.endswith(("Error", "Fault", "Refused"))]
    return table | {
        "product files": len(sources.files),
        "files with one importer": len(sources.single_importers()),
        "classes": len(classes),
        "exceptions": len(errors),
    }


def main() -> None:
    """Print the table, or one row in full."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--list", choices=[*CEILINGS])
    wanted = parser.parse_args().list
    sources = Sources.read()
    if wanted is not None:
        print(*lists(sources)[wanted], sep="\n")
        return
    print(f"{'':32}{'now':>8}{'ceiling':>9}")
    for name, figure in figures(sources).items():
        print(f"{name:32}{figure:8}{CEILINGS[name]:9}")
    for name, figure in sizes(sources).items():
        print(f"{name:32}{figure:8}")


def _tests() -> list[Path]:
    return sorted((ROOT / "tests").rglob("*.py"))


if __name__ == "__main__":
    main()
