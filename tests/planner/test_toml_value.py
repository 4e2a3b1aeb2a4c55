"""What is written as TOML is read again as it was."""

from __future__ import annotations

import tomllib
from datetime import UTC

import pytest
from hypothesis import given
from hypothesis import strategies as st

from planner.toml_text import toml_key, toml_value

texts = st.text(st.characters(codec="utf-8"))
single = (
    st.booleans()
    | st.integers(-(2**63), 2**63 - 1)
    | st.floats(allow_nan=False)
    | texts
    | st.dates()
    | st.times()
    | st.datetimes()
    | st.datetimes(timezones=st.just(UTC))
)
values = st.recursive(
    single, lambda inner: st.lists(inner) | st.dictionaries(texts, inner), max_leaves=12
)


@given(name=texts, value=values)
def test_every_kind_of_value_that_toml_has(name: str, value: object) -> None:
    assert tomllib.loads(f"{toml_key(name)} = {toml_value(value)}") == {name: value}


@pytest.mark.parametrize("value", [None, object(), {"inner": [None]}])
def test_what_toml_has_not_is_refused(value: object) -> None:
    with pytest.raises(TypeError, match="TOML has no value like"):
        toml_value(value)
