from __future__ import annotations

import pytest

_HELPERS = ("transport_contract", "can_contract", "rig", "judge", "judged", "reception", "oracle",
            "arms_bench")  # fmt: skip

pytest.register_assert_rewrite(*(f"tests.drivers.{name}" for name in _HELPERS))
