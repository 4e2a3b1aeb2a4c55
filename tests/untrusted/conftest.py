"""A designed campaign, and a copy of its folder that a test may spoil."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from tests.hil.fast_cell import fast_campaign, fast_cell


@pytest.fixture(scope="session")
def designed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("designed")
    return fast_campaign(folder / "campaign", fast_cell(folder)).folder.root


@pytest.fixture
def folder(designed: Path, tmp_path: Path) -> Path:
    return shutil.copytree(designed, tmp_path / "campaign")
