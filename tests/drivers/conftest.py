from __future__ import annotations

import pytest

_HELPERS = ("transport_contract", "can_bench", "rig", "judge", "oracle")  # fmt: skip

pytest.register_assert_rewrite(*(f"tests.drivers.{name}" for name in _HELPERS))
