"""Moments that somebody else wrote are read, or are none; reading them never fails."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.reading import instant


@given(
    st.datetimes(datetime(1971, 1, 1), datetime(2199, 1, 1)),
    st.integers(-14 * 60, 14 * 60),
)
def test_a_moment_is_read_whatever_its_zone(at: datetime, minutes: int) -> None:
    zoned = at.replace(tzinfo=timezone(timedelta(minutes=minutes)))
    assert instant(zoned.isoformat()) == zoned
    assert instant(at.isoformat()) == at.replace(tzinfo=UTC)


@given(st.one_of(st.text(), st.datetimes().map(datetime.isoformat)))
def test_any_text_is_a_moment_of_some_robot_or_none(text: str) -> None:
    found = instant(text)
    assert found is None or 1970 <= found.year < 2200


@pytest.mark.parametrize(
    "text", ["", "soon", "0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59", "1969-12-31"]
)
def test_what_is_no_moment(text: str) -> None:
    assert instant(text) is None
