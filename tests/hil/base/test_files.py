"""Atomic writing of files, and bounded reading of texts."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hil.base.errors import OutputError
from hil.base.files import write_files
from hil.base.safe_input import parse_count, parse_port, parse_time


def test_files_are_written_replaced_and_removed(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("old")
    (tmp_path / "gone").write_text("gone")
    write_files(tmp_path, {"old": "new", "bytes": b"\x00\x01", "gone": None, "never": None})
    assert {path.name for path in tmp_path.iterdir()} == {"old", "bytes"}
    assert (tmp_path / "old").read_text() == "new"
    assert (tmp_path / "bytes").read_bytes() == b"\x00\x01"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in "abd":
        (tmp_path / name).write_text("old")
    return tmp_path


def unchanged(folder: Path) -> bool:
    texts = {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}
    return texts == dict.fromkeys("abd", "old") and not any(folder.glob(".*"))


@contextmanager
def no_file_above(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("failing", ["a", "b", "c"])
def test_no_file_is_written_if_the_disk_fails_at_one(folder: Path, failing: str) -> None:
    contents = {"a": "new", "b": "new", "c": "new", "d": None, failing: b"0" * 3_000_000}
    with (
        no_file_above(2_000_000),
        pytest.raises(OutputError, match=r"too large.*nothing there was"),
    ):
        write_files(folder, contents)
    assert unchanged(folder)


@pytest.mark.parametrize("third", ["new", None])
def test_folder_in_place_of_a_file_is_named_and_left(folder: Path, third: str | None) -> None:
    (folder / "c").mkdir()
    (folder / "c" / "mine").touch()
    with pytest.raises(OutputError, match="c is a folder"):
        write_files(folder, {"a": "new", "b": None, "c": third, "d": None})
    assert (folder / "c" / "mine").exists()
    assert unchanged(folder)


def test_missing_folder_is_an_output_error(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No such file") as caught:
        write_files(tmp_path / "gone", {"a": "new"})
    assert caught.value.exit_code == 1


# --- timestamps of foreign files


@given(
    st.datetimes(datetime(1971, 1, 1), datetime(2199, 1, 1)),
    st.integers(-14 * 60, 14 * 60),
)
def test_time_is_read_in_any_zone(at: datetime, minutes: int) -> None:
    zoned = at.replace(tzinfo=timezone(timedelta(minutes=minutes)))
    assert parse_time(zoned.isoformat()) == zoned
    assert parse_time(at.isoformat()) == at.replace(tzinfo=UTC)


@pytest.mark.long
@given(st.one_of(st.text(), st.datetimes().map(datetime.isoformat)))
def test_any_text_is_a_time_in_range_or_none(text: str) -> None:
    time = parse_time(text)
    assert time is None or 1970 <= time.year < 2200


@pytest.mark.parametrize(
    "text", ["", "soon", "0001-01-01T00:00:00+23:59", "9999-12-31T23:59:59-23:59", "1969-12-31"]
)
def test_invalid_times(text: str) -> None:
    assert parse_time(text) is None


# --- numbers of foreign files


@given(st.one_of(st.text(), st.text("0123456789²٣-+_ ."), st.integers(4000, 6000).map("7".__mul__)))
def test_any_text_is_a_count_or_none(text: str) -> None:
    count = parse_count(text)
    assert count is None or (0 <= count < 2**63 and text.lstrip("0") in (str(count), ""))


def test_invalid_ports_and_counts() -> None:
    assert parse_count(None) is None
    assert parse_count("") is None
    assert [parse_port(text) for text in ("1", "1000", "65535")] == [1, 1000, 65535]
    assert not any(map(parse_port, ("", "0", "65536", "-1", "ten", "9" * 5000)))
