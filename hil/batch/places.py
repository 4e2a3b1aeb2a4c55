"""Where archives may lie: every file below some folders, every object below some addresses."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from stat import S_ISREG
from typing import Final, NamedTuple

from hil.errors import InputError

from .cache import BESIDE
from .types import Broken

_SUFFIX: Final = ".mcap"
_ARCHIVES: Final = "archives"  # folder of a campaign's archives


class Place(NamedTuple):
    """Where an archive lies, and what is known of its file without opening it.

    Attributes:
        location: path or URL.
        version: of a remote object's content, "" where its store does not say.
    """

    location: str
    version: str = ""

    @property
    def remote(self) -> bool:
        """Whether it is an address."""
        return "://" in self.location

    @property
    def name(self) -> str:
        """File name."""
        return self.location.rsplit("/", 1)[-1]

    @property
    def folder(self) -> str:
        """Folder of the file."""
        return self.location.rsplit("/", 1)[0]

    @property
    def campaign(self) -> str:
        """The campaign's folder: that of the archives, or the one above."""
        folder = self.folder
        above, _, name = folder.rpartition("/")
        return above if name == _ARCHIVES and above else folder


class Places(NamedTuple):
    """What there is below some places.

    Attributes:
        found: archives, in the order of their locations.
        refused: folders and files that cannot be looked into.
        left: links that lead nowhere.
    """

    found: tuple[Place, ...]
    refused: tuple[Broken, ...]
    left: tuple[Broken, ...]


def below(roots: Sequence[str]) -> Places:
    """Find every archive at or below some folders, archives, or URLs of either.

    Links are followed, and a folder that several lead to is looked into once, under its own name.

    Raises:
        InputError: a place does not exist, or an address cannot be read.
    """
    found: set[Place] = set()
    walk = _Walk()
    for root in roots:
        if "://" in root:
            found.update(_at(root))
            continue
        path = Path(root).resolve()
        if path.is_file():
            found.add(Place(path.as_posix()))
        elif path.is_dir():
            found.update(Place(file.as_posix()) for file in walk.below(path))
        else:
            raise InputError(root, "does not exist", remedy="name a folder with archives below it")
    return Places(tuple(sorted(found)), tuple(walk.refused), tuple(walk.left))


def _at(address: str) -> Iterable[Place]:
    from .remote_files import listed  # needs an extra

    return (Place(file.url, file.version) for file in listed(address))


class _Walk:
    """One way through any number of folders, none of them twice."""

    def __init__(self) -> None:
        self.refused: list[Broken] = []
        self.left: list[Broken] = []
        self._been: set[Path] = set()

    def below(self, root: Path) -> Iterator[Path]:
        """Archives below a folder."""
        for name, folders, files in os.walk(root, followlinks=True, onerror=self._refused):
            folder = Path(name).resolve()
            if folder in self._been:
                folders.clear()
                continue
            self._been.add(folder)
            if BESIDE in folders:
                folders.remove(BESIDE)
            yield from (folder / file for file in files if self._is_archive(folder / file))

    def _is_archive(self, path: Path) -> bool:
        if path.suffix != _SUFFIX:
            if path.is_symlink() and not path.exists():
                self.left.append(Broken(path.as_posix(), "is a link that leads nowhere"))
            return False
        try:
            regular = S_ISREG(path.stat().st_mode)
        except OSError as error:  # a link to nothing, or to itself
            self._refused(error)
            return False
        if not regular:
            self.refused.append(Broken(path.as_posix(), "is no file"))
        return regular

    def _refused(self, error: OSError) -> None:
        where = Path(os.fsdecode(error.filename)).as_posix()
        self.refused.append(Broken(where, f"cannot be looked into: {error.strerror}"))
