"""Changes of what decides the replies, one by one, that no test finds: `make mutants`.

mutmut makes the changes: an operator, a number, an argument. Here they are judged: tests are
collected once, and for each change a process is forked, gives the function its changed code and
runs the tests that reach the changed statement, quickest first, until one fails. `[tool.mutmut]` of
pyproject.toml says what is changed, by which tests it is judged, and how types are checked: a
change that they refuse needs no test.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import difflib
import gc
import importlib.machinery
import importlib.util
import itertools
import json
import math
import os
import pickle
import shutil
import signal
import subprocess
import sys
import textwrap
import threading
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib.abc import MetaPathFinder
from pathlib import Path
from types import CodeType, FrameType, FunctionType
from typing import Any, Final

import hypothesis
import mutmut.mutation.trampoline
import pytest
from mutmut.mutation.file_mutation import mutate_file_contents

ROOT: Final = Path(__file__).resolve().parent.parent
FOLDER: Final = ROOT / "build" / "mutants"
RESULTS: Final = FOLDER / "results.txt"
"""Verdict on each change, and the test that found it."""
ORIGINAL: Final = "_mutmut_orig"
"""Key of the unchanged function among its versions."""

SLOWER = 10.0
LEAST = 5.0
WAIT = 60.0
"""A test hangs, which finds the change, if it takes so many times its processor time, and at least
so many s; or on the clock that much longer."""
QUICK: Final = 100
"""Tests that have to pass without a change before any is judged."""
FOUND = 1
UNDECIDED = 3
"""Exit codes of the process of a change, 0 where it survives."""

Line = tuple[str, int]
"""Module, and line of its source with all changes."""


@dataclass(frozen=True)
class Mutant:
    """One change of one function.

    Attributes:
        name: as mutmut names it, with its module.
        function: the one that is called.
        changed: its changed version.
        difference: of their sources.
        lines: of the changed statement; a test that executes none of them cannot find the change.
    """

    name: str
    function: FunctionType
    changed: FunctionType
    difference: str
    lines: frozenset[Line]

    @property
    def place(self) -> str:
        return self.name.partition("__mutmut_")[0]


@dataclass(frozen=True)
class CleanRun:
    """A test without any change: processor time, s, and lines that it executed."""

    seconds: float
    lines: frozenset[Line]


def exchange(function: FunctionType, other: FunctionType) -> None:
    """Let a function, wherever it was imported, run the code of another."""
    function.__code__ = other.__code__
    function.__defaults__ = other.__defaults__
    function.__kwdefaults__ = other.__kwdefaults__


class Sources(MetaPathFinder):
    """Modules that are imported with all changed versions of their functions."""

    def __init__(self, paths: Sequence[str]) -> None:
        self._files = {
            path.removesuffix(".py").replace("/", "."): mutate_file_contents(
                path, (ROOT / path).read_text()
            )
            for path in paths
        }
        self._versions: list[tuple[FunctionType, dict[str, Any]]] = []
        # mutmut would ask at each call which change is active; here the function is exchanged.
        trampoline: Any = mutmut.mutation.trampoline
        trampoline.wrap_in_trampoline = self._register
        sys.meta_path.insert(0, self)

    def _register(
        self, versions: dict[str, Any], is_classmethod: bool = False
    ) -> Callable[[Any], Any]:
        def register(function: Any) -> Any:
            self._versions.append((getattr(function, "__func__", function), versions))
            return function

        return register

    def find_spec(
        self, fullname: str, path: object, target: object = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname not in self._files:
            return None
        file = str(ROOT / (fullname.replace(".", "/") + ".py"))
        loader = _Loader(fullname, file, self._files[fullname].code)
        return importlib.util.spec_from_file_location(fullname, file, loader=loader)

    def mutants(self) -> Iterator[Mutant]:
        """All changes, once the modules are imported."""
        for function, versions in self._versions:
            module = function.__module__
            spans = self._files[module].line_span_by_function_name
            text = self._files[module].code.splitlines()
            functions = {key: getattr(f, "__func__", f) for key, f in versions.items()}
            sources = {
                key: [
                    line.replace(f"def {f.__name__}(", f"def {function.__name__}(")
                    for line in text[spans[f.__name__].start - 1 : spans[f.__name__].end]
                ]
                for key, f in functions.items()
            }
            before = sources.pop(ORIGINAL)
            original = functions[ORIGINAL]
            for name, after in sources.items():
                difference = list(difflib.unified_diff(before, after, lineterm="", n=2))[3:]
                lines = changed_lines(before, after)
                start = spans[original.__name__].start
                yield Mutant(
                    f"{module}.{name}",
                    function,
                    functions[name],
                    "\n".join(difference),
                    frozenset((module, start + line) for line in lines),
                )
            exchange(function, original)  # the same code, in the lines that were compared

    def refused_by_types(self, command: Sequence[str]) -> set[str]:
        """Names of the changes that the type checker refuses."""
        shutil.rmtree(FOLDER / "drivers", ignore_errors=True)  # the checker's cache stays
        shutil.copytree(ROOT / "drivers", FOLDER / "drivers")
        shutil.copy(ROOT / "pyproject.toml", FOLDER)
        for module, file in self._files.items():
            (FOLDER / (module.replace(".", "/") + ".py")).write_text(file.code)
        report = subprocess.run(
            [sys.executable, *command[1:]], cwd=FOLDER, capture_output=True, text=True, check=False
        )
        names = set()
        for error in map(json.loads, report.stdout.splitlines()):
            module = error["file"].removesuffix(".py").replace("/", ".")
            if error["severity"] == "error" and module in self._files:
                names |= {
                    f"{module}.{name}"
                    for name, span in self._files[module].line_span_by_function_name.items()
                    if span.start <= error["line"] <= span.end
                }
        return names


class _Loader(importlib.machinery.SourceFileLoader):
    """Compiles the source given instead of the file's, and stores no bytecode of it."""

    def __init__(self, fullname: str, path: str, source: str) -> None:
        super().__init__(fullname, path)
        self._source = source

    def get_code(self, fullname: str) -> CodeType:
        code: CodeType = compile(self._source, _PREFIX + fullname, "exec", dont_inherit=True)
        return code


_PREFIX: Final = "mutants of "
"""Of the file name of a module with changes."""


def changed_lines(before: Sequence[str], after: Sequence[str]) -> set[int]:
    """Return the lines of a function, from 0, that belong to its changed statements.

    All lines where the change is not within statements, such as that of a default.
    """
    pairs = zip(before, after, strict=False)
    first = sum(1 for _ in itertools.takewhile(lambda pair: pair[0] == pair[1], pairs))
    last = len(before)
    while last > first + 1 and before[last - 1] == after[last - 1 - len(before)]:
        last -= 1
    changed = set(range(first, last))
    function = ast.parse(textwrap.dedent("\n".join(before))).body[0]
    result: set[int] = set()
    for statement in ast.walk(function):
        if isinstance(statement, ast.stmt) and statement is not function:
            # Of a compound statement its head; what it contains are statements as well.
            body = getattr(statement, "body", None)
            end = body[0].lineno - 1 if body else statement.end_lineno or statement.lineno
            lines = set(range(statement.lineno - 1, max(end, statement.lineno)))
            if lines & changed:
                result |= lines
    return result if changed <= result else set(range(len(before)))


class Tracer:
    """Collects the lines of modules with changes that are executed in its block."""

    def __init__(self) -> None:
        self.lines: set[Line] = set()

    def __enter__(self) -> None:
        threading.settrace(self._trace)
        sys.settrace(self._trace)

    def __exit__(self, *error: object) -> None:
        sys.settrace(None)
        threading.settrace(None)

    def _trace(self, frame: FrameType, event: str, argument: object) -> Any:
        file = frame.f_code.co_filename
        if not file.startswith(_PREFIX):
            return None
        module = file.removeprefix(_PREFIX)
        lines = self.lines

        def add(frame: FrameType, event: str, argument: object) -> Any:
            lines.add((module, frame.f_lineno))
            return add

        return add(frame, event, argument)


class Judge:
    """A plugin of pytest that judges changes by the collected tests instead of running them."""

    def __init__(self, sources: Sources, settings: Mapping[str, Any], options: Any) -> None:
        self._sources = sources
        self._settings = settings
        self._options = options
        self._failed: list[str] = []
        self._found_by: Counter[tuple[str, str]] = Counter()

    def pytest_sessionstart(self) -> None:
        # The first failure will do, no smallest example is needed.
        phases = [hypothesis.Phase.explicit, hypothesis.Phase.generate]
        hypothesis.settings.register_profile(
            "mutants", hypothesis.settings(hypothesis.settings.default, phases=phases)
        )
        hypothesis.settings.load_profile("mutants")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._failed.append(report.nodeid)

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        if session.testsfailed:
            pytest.exit("some tests cannot be collected")
        mutants = list(self._sources.mutants())
        if not mutants:
            pytest.exit("no module was imported with changes")
        print(f"{len(mutants)} changes, {len(session.items)} tests", flush=True)
        refused = self._sources.refused_by_types(self._settings["type_check_command"])
        print(f"{len(refused)} changes are refused by types", flush=True)
        runs = self._run_clean(session.items)
        print(f"all tests take {sum(run.seconds for run in runs.values()):.0f} s", flush=True)
        wanted = [
            mutant
            for mutant in mutants
            if mutant.name not in refused
            and any(fnmatchcase(mutant.name, pattern) for pattern in self._options.only)
        ]
        RESULTS.unlink(missing_ok=True)
        gc.freeze()
        self._require_survival_of_no_change(mutants[0].function, session.items, runs)
        self._judge(wanted, session.items, runs)
        return True

    def _run_clean(self, items: Sequence[pytest.Item]) -> dict[str, CleanRun]:
        """Run each test without a change, in a process of its own, as with one."""
        file = FOLDER / "clean_runs"
        process = os.fork()
        if process == 0:
            silence()
            runs = {}
            for item, following in itertools.zip_longest(items, items[1:]):
                tracer = Tracer()
                start = time.process_time()
                with tracer:
                    item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                runs[item.nodeid] = CleanRun(time.process_time() - start, frozenset(tracer.lines))
            file.write_bytes(pickle.dumps((self._failed, runs)))
            os._exit(0)
        os.waitpid(process, 0)
        failed, result = pickle.loads(file.read_bytes())
        if failed:
            pytest.exit(f"these fail without any change: {', '.join(failed)}")
        return dict(result)

    def _judge(
        self,
        mutants: Sequence[Mutant],
        items: Sequence[pytest.Item],
        runs: Mapping[str, CleanRun],
    ) -> None:
        verdicts: Counter[str] = Counter()
        running: dict[int, tuple[Mutant, list[pytest.Item], int]] = {}
        waiting = iter(mutants)
        while True:
            for mutant in itertools.islice(waiting, self._options.jobs - len(running)):
                tests = self._tests_of(mutant, items, runs)
                process, reading = self._start(mutant, tests, runs)
                running[process] = mutant, tests, reading
            if not running:
                break
            process, status = os.wait()
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process, signal.SIGKILL)  # what its tests have started
            mutant, tests, reading = running.pop(process)
            with os.fdopen(reading, "rb") as pipe:
                begun = pipe.read()
            verdict = verdict_of(os.waitstatus_to_exitcode(status)) if tests else "not reached"
            verdicts[verdict] += 1
            last = tests[len(begun) - 1].nodeid if begun else ""
            with RESULTS.open("a") as results:
                results.write(
                    f"{mutant.name} {verdict}; {len(begun)} of {len(tests)} tests, {last}\n"
                )
            if verdict in ("survives", "undecided", "not reached"):
                print(f"\n{mutant.name}: {verdict}\n{mutant.difference}", flush=True)
            else:
                self._found_by[mutant.place, last] += 1
        print(f"\n{len(mutants)} changes: {', '.join(f'{n} {v}' for v, n in verdicts.items())}")

    def _tests_of(
        self, mutant: Mutant, items: Sequence[pytest.Item], runs: Mapping[str, CleanRun]
    ) -> list[pytest.Item]:
        """Tests that reach the change, quickest first; those that found others there count less."""

        def cost(item: pytest.Item) -> float:
            return runs[item.nodeid].seconds / (1 + self._found_by[mutant.place, item.nodeid])

        return sorted((i for i in items if runs[i.nodeid].lines & mutant.lines), key=cost)

    def _require_survival_of_no_change(
        self, function: FunctionType, items: Sequence[pytest.Item], runs: Mapping[str, CleanRun]
    ) -> None:
        """Stop if tests fail in a process like those of the changes, without a change."""
        none = Mutant("no change", function, function, "", frozenset())
        tests = sorted(items, key=lambda item: runs[item.nodeid].seconds)[:QUICK]
        process, reading = self._start(none, tests, runs)
        _, status = os.waitpid(process, 0)
        os.close(reading)
        if status:
            pytest.exit(
                f"tests without any change: {verdict_of(os.waitstatus_to_exitcode(status))}"
            )

    def _start(
        self, mutant: Mutant, tests: Sequence[pytest.Item], runs: Mapping[str, CleanRun]
    ) -> tuple[int, int]:
        """Fork the process of a change; return its number, and a file with a byte per test."""
        reading, writing = os.pipe()
        process = os.fork()
        if process == 0:
            self._run_changed(mutant, tests, runs, writing)
        os.close(writing)
        return process, reading

    def _run_changed(
        self,
        mutant: Mutant,
        tests: Sequence[pytest.Item],
        runs: Mapping[str, CleanRun],
        pipe: int,
    ) -> None:
        """Run tests until one fails, and end this process; a byte into `pipe` begins each."""
        code = FOUND  # by whatever a test raises that ends pytest
        try:
            os.setpgid(0, 0)
            silence()
            exchange(mutant.function, mutant.changed)
            for item, following in itertools.zip_longest(tests, tests[1:]):
                os.write(pipe, b".")
                limit = max(LEAST, SLOWER * runs[item.nodeid].seconds)
                signal.setitimer(signal.ITIMER_PROF, limit)
                signal.setitimer(signal.ITIMER_REAL, limit + WAIT)
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if self._failed:
                    return
                if time.process_time() > self._options.seconds:
                    code = UNDECIDED
                    return
            code = 0
        finally:
            os._exit(code)


def verdict_of(code: int) -> str:
    """Return what the exit code of a change's process means."""
    if code in (-signal.SIGPROF, -signal.SIGALRM):
        return "hang"
    names = {0: "survives", FOUND: "found", UNDECIDED: "undecided"}
    return names.get(code, f"end with {code}")


def silence() -> None:
    """Let this process print nothing."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nothing, stream)


def main() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["mutmut"]
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=__doc__)
    parser.add_argument("modules", nargs="*", help="such as drivers/guard.py; all by default")
    parser.add_argument("--only", nargs="+", default=["*"], help="names of changes, or patterns")
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--seconds", type=float, default=math.inf, help="most for one change")
    options = parser.parse_args()
    os.chdir(ROOT)
    for path in options.modules:
        if not Path(path).is_file():
            parser.error(f"{path}: there is no such module; name one such as drivers/guard.py")
    sources = Sources(options.modules or settings["only_mutate"])
    arguments = [
        *settings["pytest_add_cli_args"],
        *settings["pytest_add_cli_args_test_selection"],
        # Rewriting of asserts would import the modules of an installed package in our place.
        *("-n", "0", "-s", "--assert=plain", "-W", "ignore:Module already imported"),
    ]
    sys.exit(pytest.main(arguments, plugins=[Judge(sources, settings, options)]))


if __name__ == "__main__":
    main()
