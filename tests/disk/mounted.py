"""Disks to be put under a campaign: through FUSE, or planted under Python's own functions."""

from __future__ import annotations

import builtins
import importlib.util
import io
import json
import os
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol
from unittest.mock import patch

from hil.files import write_atomically
from tests.disk.faults import CREATE, RENAME, SYNC, WRITE, Faults, Rule, of_text, to_text

MOUNT_TIMEOUT = 20.0
RULES, STRUCK = "rules.json", "struck.txt"


class Disk(Protocol):
    """A disk that can be told what to do wrong.

    Attributes:
        root: folder on it.
    """

    @property
    def root(self) -> Path:
        """Folder on it."""

    def do_wrong(self, *rules: Rule) -> list[str]:
        """Put these rules in force, none: be well; what those before have struck."""


class NoFuseError(Exception):
    """Why no file system can be mounted here."""


class FuseDisk:
    """A folder behind a process of its own, seen by every process of this computer."""

    def __init__(self, process: subprocess.Popen[str], root: Path) -> None:
        self._process, self._root = process, root

    @property
    def root(self) -> Path:
        return self._root

    def do_wrong(self, *rules: Rule) -> list[str]:
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(to_text(rules) + "\n")
        self._process.stdin.flush()
        struck: list[str] = json.loads(self._process.stdout.readline())
        return struck


@contextmanager
def fuse_disk(folder: Path) -> Iterator[FuseDisk]:
    """Mount one below a folder.

    Raises:
        NoFuseError: that is not possible here.
    """
    if importlib.util.find_spec("mfusepy") is None:
        raise NoFuseError("mfusepy (extra `fuse`) is not installed")
    if not os.access("/dev/fuse", os.R_OK | os.W_OK):
        raise NoFuseError("/dev/fuse cannot be opened")
    behind, root = folder / "behind", folder / "mounted"
    behind.mkdir()
    root.mkdir()
    command = [sys.executable, "-m", "tests.disk.passthrough", str(behind), str(root)]
    with tempfile.TemporaryFile() as words:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=words, text=True
        )
        try:
            deadline = time.monotonic() + MOUNT_TIMEOUT
            while not root.is_mount():
                if process.poll() is not None or time.monotonic() > deadline:
                    words.seek(0)
                    said = words.read().decode(errors="replace").strip().splitlines()
                    raise NoFuseError(f"cannot be mounted: {said[-1] if said else 'no answer'}")
                time.sleep(0.02)
            yield FuseDisk(process, root)
        finally:
            with suppress(OSError):
                process.stdin.close()  # type: ignore[union-attr]
            try:
                process.wait(10.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                subprocess.run(["umount", "--lazy", str(root)], check=False, capture_output=True)
            process.stdout.close()  # type: ignore[union-attr]


class PlantedDisk:
    """A folder that this process alone sees failing, where nothing can be mounted."""

    def __init__(self, root: Path) -> None:
        self._root, self._faults = root.resolve(), Faults()

    @property
    def root(self) -> Path:
        return self._root

    @property
    def struck(self) -> list[str]:
        """What was refused since the rules came."""
        return self._faults.struck

    def do_wrong(self, *rules: Rule) -> list[str]:
        struck = self._faults.struck
        self._faults.set(rules)
        return struck

    def meet(self, operation: str, where: object) -> None:
        """Let an operation fail that is on this disk."""
        path = _path(where)
        if path is not None and path.is_relative_to(self._root):
            self._faults.meet(operation, str(path))


class ToldDisk(PlantedDisk):
    """The same in a process that was started by another, which leaves the rules in a file."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._rules, self._text = root.parent / RULES, ""

    def meet(self, operation: str, where: object) -> None:
        path = _path(where)
        if path is None or not path.is_relative_to(self._root):
            return
        text = self._rules.read_text() if self._rules.exists() else "[]"
        if text != self._text:
            self._text = text
            self._faults.set(of_text(text))
        before = len(self._faults.struck)
        try:
            self._faults.meet(operation, str(path))
        finally:
            with (self._root.parent / STRUCK).open("a") as log:
                log.writelines(f"{line}\n" for line in self._faults.struck[before:])


class ProcessesDisk:
    """A folder that every Python process sees failing which is started with `environment`."""

    def __init__(self, root: Path) -> None:
        self._root = root

    @property
    def root(self) -> Path:
        return self._root

    def do_wrong(self, *rules: Rule) -> list[str]:
        log = self._root.parent / STRUCK
        struck = log.read_text().splitlines() if log.exists() else []
        log.unlink(missing_ok=True)
        write_atomically(self._root.parent / RULES, to_text(rules))
        return struck


def _path(where: object) -> Path | None:
    if isinstance(where, int):
        with suppress(OSError):
            return Path(f"/proc/self/fd/{where}").readlink()
        return None
    return Path.cwd() / os.fsdecode(where)  # type: ignore[arg-type]


def plant(disk: PlantedDisk) -> ExitStack:
    """Put a disk under the functions that write, create, flush and rename.

    These are some of `os`, and `open`.
    """

    def met(
        name: str, operation: str, which: int = 0, when: Callable[..., bool] = lambda *_: True
    ) -> Callable[..., Any]:
        true = getattr(os, name)

        def function(*arguments: Any, **named: Any) -> Any:
            if when(*arguments):
                disk.meet(operation, arguments[which])
            return true(*arguments, **named)

        return function

    functions: Sequence[tuple[str, Callable[..., Any]]] = (
        ("write", met("write", WRITE)),
        ("fsync", met("fsync", SYNC, when=_is_file)),
        ("fdatasync", met("fdatasync", SYNC, when=_is_file)),
        ("rename", met("rename", RENAME, which=1)),
        ("replace", met("replace", RENAME, which=1)),
        ("open", met("open", CREATE, when=lambda _path, flags, *_: bool(flags & os.O_CREAT))),
    )
    undo = ExitStack()
    for name, function in functions:
        undo.enter_context(patch.object(os, name, function))
    for module in (io, builtins):  # the first is what `Path.open` calls
        undo.enter_context(patch.object(module, "open", _opening(disk, io.open)))
    return undo


def _is_file(descriptor: int) -> bool:
    """Not a folder: whose names are flushed where its file system can do that, and else not."""
    return stat.S_ISREG(os.fstat(descriptor).st_mode)


class _Raw(io.FileIO):
    """A file that asks the disk before it writes: `FileIO` does not call `os.write`."""

    def __init__(self, disk: PlantedDisk, path: Path, mode: str) -> None:
        self._disk, self._path = disk, path
        super().__init__(path, mode)

    def write(self, data: Any, /) -> int | None:  # type: ignore[override]  # as FileIO itself
        self._disk.meet(WRITE, self._path)
        return super().write(data)


def _opening(disk: PlantedDisk, true: Callable[..., Any]) -> Callable[..., Any]:
    """As `open`: a file that is made on this disk, or written to, asks it before."""

    def function(file: Any, mode: str = "r", *arguments: Any, **named: Any) -> Any:
        path = None if isinstance(file, int) else _path(file)
        if path is None or not set(mode) & set("wax") or not path.is_relative_to(disk.root):
            return true(file, mode, *arguments, **named)
        disk.meet(CREATE, path)
        raw = _Raw(disk, path, mode.replace("b", "").replace("t", ""))
        buffered = io.BufferedRandom(raw) if "+" in mode else io.BufferedWriter(raw)
        if "b" in mode:
            return buffered
        words = {key: named[key] for key in ("encoding", "errors", "newline") if key in named}
        return io.TextIOWrapper(buffered, **words)

    return function


@contextmanager
def planted_disk(folder: Path) -> Iterator[PlantedDisk]:
    """One under the functions of this process."""
    root = folder / "planted"
    root.mkdir()
    disk = PlantedDisk(root)
    with plant(disk):
        yield disk


@contextmanager
def processes_disk(folder: Path) -> Iterator[ProcessesDisk]:
    """One under the functions of every process that is started while this is open."""
    root, code = folder / "planted", folder / "code"
    root.mkdir()
    code.mkdir()
    here = Path(__file__).parents[2]
    (code / "sitecustomize.py").write_text(
        f"import sys\nsys.path.insert(0, {str(here)!r})\n"
        "from pathlib import Path\nfrom tests.disk.mounted import ToldDisk, plant\n"
        f"undo = plant(ToldDisk(Path({str(root.resolve())!r})))\n"
    )
    path = os.pathsep.join([str(code), os.environ.get("PYTHONPATH", "")])
    # The product hands on to its processes what this one can import.
    with patch.dict(os.environ, PYTHONPATH=path), patch.object(sys, "path", [str(code), *sys.path]):
        yield ProcessesDisk(root.resolve())
