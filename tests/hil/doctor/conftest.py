from __future__ import annotations

import sys
from pathlib import Path

import pytest

# What these tests share is a module beside them.
sys.path.insert(0, str(Path(__file__).parent))

from made_up_system import Tree


@pytest.fixture
def tree(tmp_path: Path) -> Tree:
    return Tree(tmp_path)
