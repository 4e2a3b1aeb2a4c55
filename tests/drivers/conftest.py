from __future__ import annotations

import sys
from pathlib import Path

import pytest

# Helpers shared by these tests are modules beside them.
sys.path.insert(0, str(Path(__file__).parent))
pytest.register_assert_rewrite(
    *("transport_contract", "can_contract", "rig", "judge", "judged", "reception", "oracle"),
    *("session_machine", "arms_bench"),
)
