from __future__ import annotations

from pathlib import Path

import pytest

from tests.hil.doctor.made_up_system import Tree


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)
