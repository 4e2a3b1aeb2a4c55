"""A system of files and canned commands, for judgements to be made of."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from hil.doctor.check import Answer, System


class Commands:
    """Canned answers of commands, by their first word; any other is not installed."""

    def __init__(self, **answers: Answer) -> None:
        self.answers = answers

    def __call__(self, command: Sequence[str]) -> Answer | None:
        return self.answers.get(command[0])


class Tree:
    """A made-up system below a folder."""

    def __init__(self, root: Path) -> None:
        self.root = root

    def write(self, files: dict[str, str]) -> Tree:
        for name, text in files.items():
            path = self.root / name.lstrip("/")
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(text)
        return self

    def system(self, **commands: Answer) -> System:
        return System(self.root, Commands(**commands))


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)
