"""The folder of a design: what lies where, and who may write to it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, cast

from hil.errors import InputError
from hil.files import exclusive_folder, write_atomically
from hil.reading import opened
from planner.toml_text import to_text

from .result import RESULT
from .settings import DesignSettings, SettingsError, load_settings

PICTURE, SETTINGS, JOURNAL = "excitation.png", "settings.toml", "search.journal"
DESIGN_FILES = frozenset((RESULT, PICTURE, SETTINGS, JOURNAL))
"""What a design leaves; a campaign of its motion may lie beside it."""

_HEAD = "# The settings of the search in this folder; `hil design --resume` goes on with them.\n"


@dataclass(frozen=True)
class DesignFolder:
    """Paths below one folder."""

    root: Path

    @property
    def result(self) -> Path:
        """The motion, its criteria, and all that it came from."""
        return self.root / RESULT

    @property
    def picture(self) -> Path:
        """The same for the eye."""
        return self.root / PICTURE

    @property
    def settings(self) -> Path:
        """What was asked for."""
        return self.root / SETTINGS

    @property
    def journal(self) -> Path:
        """What was scored so far."""
        return self.root / JOURNAL

    def held(self) -> AbstractContextManager[None]:
        """Make the folder, and keep every other search out of it until this is left."""
        return exclusive_folder(self.root, "search", "-o")

    def begin(self, settings: DesignSettings, *, force: bool) -> None:
        """Make room for a new design, and write down what is asked for; the folder is held.

        Raises:
            InputError: there is a design already and it is not to be replaced, or the folder
                cannot be written to.
        """
        ours = [path for path in (self.result, self.journal) if path.exists()]
        if self._begun():
            ours.append(self.settings)
        elif self.settings.exists():
            raise InputError(
                self.settings,
                "is in the way: the settings of the design are to be written there",
                remedy="name another folder (-o), or move the file",
            )
        if ours and not force:
            raise InputError(
                self.root,
                f"holds a design already ({ours[0].name})",
                remedy="go on with it (--resume), name another folder (-o), or add --force",
            )
        with self._written():
            for path in (self.result, self.picture, self.journal, self.settings):
                path.unlink(missing_ok=True)
            write_atomically(self.settings, _HEAD + "\n" + to_text(settings.to_dict(), {}))

    def interrupted(self) -> DesignSettings:
        """Return the settings of the design in this folder.

        Raises:
            InputError: there is none.
        """
        if not self._begun():
            raise InputError(
                self.root,
                "holds no design to go on with",
                remedy="begin one without --resume, or name its folder (-o)",
            )
        return load_settings(self.settings)

    def _begun(self) -> bool:
        """Return whether the settings in the folder are those of a design, not a person's own."""
        try:
            with opened(self.settings) as file:
                return file.read(len(_HEAD)) == _HEAD.encode()
        except OSError:
            return False

    @contextmanager
    def opened_journal(self) -> Iterator[BinaryIO]:
        """Open the journal, a new one if there is none; the folder is held.

        Raises:
            InputError: the disk refuses.
        """
        with self._written():
            # Without a buffer nothing is left that closing the file would fail to write.
            if self.journal.exists():
                opened(self.journal).close()  # which refuses what is no file
            file = self.journal.open("r+b" if self.journal.exists() else "x+b", buffering=0)
        with file:
            yield cast(BinaryIO, file)

    @contextmanager
    def _written(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise InputError(
                self.root,
                f"cannot be written to ({error.strerror})",
                remedy="make room, or name another folder (-o)",
            ) from error


def require_same(asked: DesignSettings, there: DesignSettings, path: Path) -> None:
    """Refuse to go on with a search under other settings than those it began with.

    Raises:
        SettingsError: names the first field that differs.
    """
    ours, theirs = _flat(asked.to_dict()), _flat(there.to_dict())
    for field in sorted(ours.keys() | theirs.keys()):
        if ours.get(field) != theirs.get(field):
            raise SettingsError(
                path,
                f"was {theirs.get(field)!r} when the search began",
                field=f"{field} = {ours.get(field)!r}",
                remedy="resume it without other settings, or begin anew in another folder (-o)",
            )


def _flat(data: dict[str, object]) -> dict[str, object]:
    flat: dict[str, object] = {}
    for name, value in data.items():
        if isinstance(value, dict):
            flat |= {f"{name}.{key}": entry for key, entry in _flat(value).items()}
        else:
            flat[name] = value
    return flat
