"""Numbers and moments that somebody else wrote are read, or are none; reading never fails."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta, timezone

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.reading import instant, port_number, whole_number


@given(st.integers(0, 10**18 - 1))
def test_a_number_is_read_as_it_was_written(number: int) -> None:
    assert whole_number(str(number)) == number


@given(st.one_of(st.text(), st.text("0123456789²٣-+_ ."), st.integers(4000, 6000).map("7".__mul__)))
def test_any_text_is_a_number_of_some_size_or_none(text: str) -> None:
    found = whole_number(text)
    assert found is None or (0 <= found < 2**63 and text.lstrip("0") in (str(found), ""))


def test_what_is_missing_is_none() -> None:
    assert whole_number(None) is None
    assert whole_number("") is None


def test_ports_are_those_that_there_are() -> None:
    assert [port_number(text) for text in ("1", "1000", "65535")] == [1, 1000, 65535]
    assert not any(map(port_number, ("", "0", "65536", "-1", "ten", "9" * 5000)))


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
