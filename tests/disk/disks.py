"""Simulated disks that are slow, hang or fail on demand.

Python's functions are patched. Files beside the folder contain the active rules and the operations
they affected, so that other processes may write below it.
"""

from __future__ import annotations

import builtins
import fnmatch
import io
import json
import os
import stat
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hil.base.files import write_atomically
from tests.faults import CREATE, REFUSALS, RENAME, SYNC, WRITE, DiskFault

RULES = "rules.json"
STRUCK = "struck.txt"


class Disk:
    def __init__(self, root: Path) -> None:
        self.root = root
        self._count = 0

    def do_wrong(self, *rules: DiskFault) -> list[str]:
        """Activate these rules (none: no faults); return the operations affected before."""
        log = self.root.parent / STRUCK
        struck = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        self._count += 1  # the same rules again start from zero
        text = json.dumps([self._count, *map(asdict, rules)])
        write_atomically(self.root.parent / RULES, text)
        return struck


class Faults:
    """The rules of a disk in a process that writes to it; thread-safe."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self._folder = root.parent
        self._lock = threading.Lock()
        self._text = ""
        self._rules: list[DiskFault] = []
        self._seen: dict[int, int] = {}
        self._until: dict[int, float] = {}

    def meet(self, operation: str, path: str) -> None:
        """Wait or raise OSError according to the rules."""
        with self._lock:
            self._read()
            delay = 0.0
            error = 0
            for number, rule in enumerate(self._rules):
                name = Path(path).name
                if operation not in rule.operations or not fnmatch.fnmatch(name, rule.names):
                    continue
                count = self._seen[number] = self._seen.get(number, 0) + 1
                if count <= rule.after or (rule.times and count > rule.after + rule.times):
                    continue
                until = self._until.setdefault(number, time.monotonic() + rule.hang)
                delay = max(delay, until - time.monotonic())
                error = error or REFUSALS.get(rule.error, 0)
                with (self._folder / STRUCK).open("a") as log:
                    log.write(f"{operation} {name}\n")
        if delay > 0.0:
            time.sleep(delay)
        if error:
            raise OSError(error, os.strerror(error), path)

    def meet_at(self, operation: str, where: object) -> None:
        """Apply the rules to a path or an open file on this disk."""
        path = _path(where)
        if path is not None and path.is_relative_to(self.root):
            self.meet(operation, str(path))

    def _read(self) -> None:
        file = self._folder / RULES
        text = file.read_text() if file.exists() else "[0]"
        if text != self._text:
            self._text = text
            self._seen = {}
            self._until = {}
            self._rules = [DiskFault(**rule) for rule in json.loads(text)[1:]]


@contextmanager
def planted_disk(folder: Path) -> Iterator[Disk]:
    """Patch the functions of this process."""
    root = (folder / "planted").resolve()
    root.mkdir()
    with plant(Faults(root)):
        yield Disk(root)


@contextmanager
def processes_disk(folder: Path) -> Iterator[Disk]:
    """Patch the functions of every process that is started meanwhile."""
    root = (folder / "planted").resolve()
    code = folder / "code"
    root.mkdir()
    code.mkdir()
    (code / "sitecustomize.py").write_text(
        f"import sys\nsys.path.insert(0, {str(Path(__file__).parents[2])!r})\n"
        "from pathlib import Path\nfrom tests.disk.disks import Faults, plant\n"
        f"undo = plant(Faults(Path({str(root)!r})))\n"
    )
    path = os.pathsep.join([str(code), os.environ.get("PYTHONPATH", "")])
    # The product passes `sys.path` to its processes.
    with patch.dict(os.environ, PYTHONPATH=path), patch.object(sys, "path", [str(code), *sys.path]):
        yield Disk(root)


def _path(where: object) -> Path | None:
    if isinstance(where, int):
        with suppress(OSError):
            return Path(f"/proc/self/fd/{where}").readlink()
        return None
    return Path.cwd() / os.fsdecode(where)  # type: ignore[arg-type]


def plant(faults: Faults) -> ExitStack:
    """Patch `open` and the functions of `os` that write, create, flush and rename."""

    def met(
        name: str, operation: str, which: int = 0, when: Callable[..., bool] = lambda *_: True
    ) -> tuple[str, Callable[..., Any]]:
        true = getattr(os, name)

        def function(*arguments: Any, **named: Any) -> Any:
            if when(*arguments):
                faults.meet_at(operation, arguments[which])
            return true(*arguments, **named)

        return name, function

    undo = ExitStack()
    for name, function in (
        met("write", WRITE),
        met("fsync", SYNC, when=_is_file),
        met("fdatasync", SYNC, when=_is_file),
        met("rename", RENAME, which=1),
        met("replace", RENAME, which=1),
        met("open", CREATE, when=lambda _path, flags, *_: bool(flags & os.O_CREAT)),
    ):
        undo.enter_context(patch.object(os, name, function))
    for module in (io, builtins):  # the first is what `Path.open` calls
        undo.enter_context(patch.object(module, "open", _opening(faults, io.open)))
    return undo


def _is_file(descriptor: int) -> bool:
    """Return whether it is no folder, which not all file systems can flush."""
    return stat.S_ISREG(os.fstat(descriptor).st_mode)


class _Raw(io.FileIO):
    """A file whose writes follow the rules: `FileIO` does not call `os.write`."""

    def __init__(self, faults: Faults, path: Path, mode: str) -> None:
        self._faults = faults
        self._path = path
        super().__init__(path, mode)

    def write(self, data: Any, /) -> int | None:  # type: ignore[override]  # as FileIO itself
        self._faults.meet(WRITE, str(self._path))
        return super().write(data)


def _opening(faults: Faults, true: Callable[..., Any]) -> Callable[..., Any]:
    """Return `open` that applies the rules to files created or written on this disk."""

    def function(file: Any, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        path = None if isinstance(file, int) else _path(file)
        if path is None or not set(mode) & set("wax") or not path.is_relative_to(faults.root):
            return true(file, mode, *arguments, **named)
        faults.meet(CREATE, str(path))
        raw = _Raw(faults, path, mode.replace("b", "").replace("t", ""))
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return buffered
        text_options = {
            key: named[key] for key in ("encoding", "errors", "newline") if key in named
        }
        return io.TextIOWrapper(buffered, **text_options)

    return function
