"""What a disk does wrong, and when: rules that both the planted and the FUSE disk follow."""

from __future__ import annotations

import errno
import fnmatch
import json
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

CREATE, WRITE, SYNC, RENAME = "create", "write", "fsync", "rename"
CHANGES: Final = (CREATE, WRITE, SYNC, RENAME)  # Operations on which a disk may fail or hang
REFUSALS: Final = {"EIO": errno.EIO, "EDQUOT": errno.EDQUOT, "ENOSPC": errno.ENOSPC}


@dataclass(frozen=True)
class Rule:
    """One thing that goes wrong."""

    operations: Sequence[str] = CHANGES  # on which of `CHANGES`
    names: str = "*"  # pattern of the names of files it is about
    after: int = 0  # how many matching operations pass before it begins
    times: int = 0  # on how many it then acts; 0: on all
    error: str = ""  # name of the error, "" for none
    delay: float = 0.0  # s that each of them takes longer
    hang: float = 0.0  # s, counted from the first of them, until which none of them ends


class Faults:
    """Rules in force, and what they have done; any thread may ask."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._rules: tuple[Rule, ...] = ()
        self._seen: dict[int, int] = {}
        self._until: dict[int, float] = {}
        self.struck: list[str] = []

    def set(self, rules: Sequence[Rule]) -> None:
        """Put other rules in force; what was counted begins anew."""
        with self._lock:
            self._rules, self._seen, self._until = tuple(rules), {}, {}
            self.struck = []

    def meet(self, operation: str, path: str) -> None:
        """Be late, or raise OSError, if a rule says so."""
        delay = 0.0
        error = 0
        with self._lock:
            for number, rule in enumerate(self._rules):
                if operation not in rule.operations:
                    continue
                if not fnmatch.fnmatch(Path(path).name, rule.names):
                    continue
                count = self._seen[number] = self._seen.get(number, 0) + 1
                if count <= rule.after or (rule.times and count > rule.after + rule.times):
                    continue
                until = self._until.setdefault(number, time.monotonic() + rule.hang)
                delay = max(delay, rule.delay, until - time.monotonic())
                error = error or REFUSALS.get(rule.error, 0)
                self.struck.append(f"{operation} {Path(path).name}")
        if delay > 0.0:
            time.sleep(delay)
        if error:
            raise OSError(error, os.strerror(error), path)


def to_text(rules: Sequence[Rule]) -> str:
    """Rules as JSON."""
    return json.dumps([asdict(rule) for rule in rules])


def of_text(text: str) -> list[Rule]:
    """The rules again."""
    return [Rule(**one) for one in json.loads(text)]
