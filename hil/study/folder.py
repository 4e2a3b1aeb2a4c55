"""The folder of a study: what lies where, and who may write to it."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from hil.errors import InputError
from hil.files import make_folder, write_or_tell

from .settings import StudySettings

SETTINGS, RESULTS, REPORT = "study.json", "results.json", "report.html"


@dataclass(frozen=True)
class StudyFolder:
    """Paths below one folder; what is whole in it is never made again."""

    root: Path

    def design(self, key: str) -> Path:
        """Folder of one search."""
        return self.root / "designs" / key

    def campaign(self, condition: str, key: str) -> Path:
        """Campaign folder of one excitation under one condition."""
        return self.root / "campaigns" / condition / key

    @property
    def fits(self) -> Path:
        """What was read from archives, one file each."""
        return self.root / "fits"

    @property
    def results(self) -> Path:
        """All numbers."""
        return self.root / RESULTS

    @property
    def report(self) -> Path:
        """The same for people."""
        return self.root / REPORT

    @property
    def settings(self) -> Path:
        """What was asked for."""
        return self.root / SETTINGS

    @contextmanager
    def held(self) -> Iterator[None]:
        """Make the folder, and keep every other study out of it until this is left.

        Raises:
            InputError: another study is at work in it, or it cannot be made.
        """
        make_folder(self.root)
        descriptor = os.open(self.root, os.O_RDONLY | os.O_DIRECTORY)
        try:
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                raise InputError(
                    self.root,
                    "another study is at work in it",
                    remedy="wait for its end, stop it (Ctrl-C), or name another folder (--output)",
                ) from error
            yield
        finally:
            os.close(descriptor)

    def begin(self, settings: StudySettings) -> None:
        """Write down what is asked for, or go on with a study that was asked for the same.

        Raises:
            InputError: the folder holds something else, or a study with other settings.
        """
        if not self.settings.exists():
            if any(self.root.iterdir()):
                raise InputError(
                    self.root,
                    "is not empty and holds no study",
                    remedy="name another folder (--output)",
                )
            write_or_tell(self.settings, settings.to_json())
            return
        there = StudySettings.load(self.settings)
        for name in type(settings).model_fields:
            asked, begun = getattr(settings, name), getattr(there, name)
            if asked != begun:
                raise InputError(
                    self.settings,
                    f"the study in this folder was begun with {begun!s}, not {asked!s}",
                    field=name,
                    remedy="ask for the same to go on with it, or name another folder (--output)",
                )
