"""The result of a check, and access to files and commands of the system."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import wraps
from pathlib import Path
from typing import Any, NamedTuple, ParamSpec


class Status(StrEnum):
    """Result of a check: works, may cost latency, fails, is not known."""

    OK = "ok"
    WARN = "warn"
    BAD = "bad"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class Check:
    """The result of one check: status, facts, shell commands as remedy, and its reason."""

    name: str
    status: Status
    found: str
    remedy: tuple[str, ...] = ()
    why: str = ""


Outcome = Callable[..., Check]
P = ParamSpec("P")


def _with_status(status: Status) -> Outcome:
    def check(found: str, *remedy: str) -> Check:
        return Check("", status, found, remedy)

    return check


ok, warn, bad, unknown = map(_with_status, Status)


def named(name: str) -> Callable[[Callable[P, Check]], Callable[P, Check]]:
    """Set the name of a check, formatted with its arguments; its docstring is the reason."""

    def decorate(check: Callable[P, Check]) -> Callable[P, Check]:
        why = " ".join((check.__doc__ or "").split()).removesuffix(".")

        @wraps(check)
        def checked(*args: P.args, **kwargs: P.kwargs) -> Check:
            found = check(*args, **kwargs)
            return replace(found, name=name.format(*args), why=why[0].lower() + why[1:])

        return checked

    return decorate


COMMAND_TIMEOUT = 3.0
"""Time limit of a command, s."""
_LARGEST = 4_000_000


class Answer(NamedTuple):
    """Exit status and output of a command."""

    status: int
    output: str
    errors: str = ""


def run_command(command: Sequence[str]) -> Answer | None:
    """Run a command without input; None if it is not installed or exceeds the time limit."""
    path = shutil.which(command[0], path="/usr/sbin:/usr/bin:/sbin:/bin:/usr/local/bin")
    if path is None:
        return None
    try:
        done = subprocess.run(
            [path, *command[1:]],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=COMMAND_TIMEOUT,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return None
    return Answer(done.returncode, done.stdout, done.stderr)


@dataclass(frozen=True)
class System:
    """Source of facts: `root` is the prefix of every path, `run` runs a command."""

    root: Path = Path("/")
    run: Callable[[Sequence[str]], Answer | None] = run_command

    def path(self, name: str) -> Path:
        """Return the path of the file `name` (absolute)."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str | None:
        """Return the stripped text of a file; None if it cannot be read."""
        try:
            with self.path(name).open("rb") as file:
                return file.read(_LARGEST).decode("utf-8", errors="replace").strip()
        except OSError:
            return None

    def number(self, name: str) -> int | None:
        """Return the integer in a file; None if there is none."""
        try:
            return int(self.text(name) or "")
        except ValueError:
            return None

    def names(self, folder: str) -> list[str]:
        """Return the sorted names in a folder; none if it cannot be read."""
        try:
            return sorted(path.name for path in self.path(folder).iterdir())
        except OSError:
            return []

    def ip(self, *words: str) -> list[dict[str, Any]] | None:
        """Return the output of `ip`; empty if it fails, None if it is not installed."""
        answer = self.run(["ip", "-json", *words])
        try:
            return None if answer is None else [*json.loads(answer.output)]
        except ValueError:
            return []
