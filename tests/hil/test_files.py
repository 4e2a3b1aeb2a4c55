"""Files that are replaced together: all or none."""

from __future__ import annotations

import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from hil.errors import OutputError
from hil.files import write_together


def test_files_are_written_replaced_and_taken_away(tmp_path: Path) -> None:
    (tmp_path / "old").write_text("old")
    (tmp_path / "gone").write_text("gone")
    write_together(tmp_path, {"old": "new", "bytes": b"\x00\x01", "gone": None, "never": None})
    assert {path.name for path in tmp_path.iterdir()} == {"old", "bytes"}
    assert (tmp_path / "old").read_text() == "new"
    assert (tmp_path / "bytes").read_bytes() == b"\x00\x01"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name in "abd":
        (tmp_path / name).write_text("old")
    return tmp_path


def unchanged(folder: Path) -> bool:
    found = {path.name: path.read_text() for path in folder.iterdir() if path.is_file()}
    return found == dict.fromkeys("abd", "old") and not any(folder.glob(".*"))


@contextmanager
def no_file_above(size: int) -> Iterator[None]:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.mark.parametrize("failing", ["a", "b", "c"])
def test_if_the_disk_takes_one_of_them_no_more_none_is_written(folder: Path, failing: str) -> None:
    contents = {"a": "new", "b": "new", "c": "new", "d": None, failing: b"0" * 3_000_000}
    with (
        no_file_above(2_000_000),
        pytest.raises(OutputError, match=r"too large.*nothing there was"),
    ):
        write_together(folder, contents)
    assert unchanged(folder)


@pytest.mark.parametrize("taken", ["new", None])
def test_a_folder_in_the_way_is_named_and_left(folder: Path, taken: str | None) -> None:
    (folder / "c").mkdir()
    (folder / "c" / "mine").touch()
    with pytest.raises(OutputError, match="c is a folder"):
        write_together(folder, {"a": "new", "b": None, "c": taken, "d": None})
    assert (folder / "c" / "mine").exists()
    assert unchanged(folder)


@pytest.mark.parametrize("links", [True, False])
@pytest.mark.parametrize("failing", ["a", "b", "c"])
def test_if_one_cannot_get_to_its_place_the_others_are_put_back(
    folder: Path, failing: str, links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also on file systems where a file has one name only."""
    replace = Path.replace

    def sometimes(path: Path, target: Path) -> Path:
        if path.name == failing and path.parent.name == "new":
            raise PermissionError(1, "Operation not permitted")
        return replace(path, target)

    def refused(*_: object, **__: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(Path, "replace", sometimes)
    if not links:
        monkeypatch.setattr("os.link", refused)
    with pytest.raises(OutputError, match="not permitted"):
        write_together(folder, {"d": None, "c": "new", "a": "new", "b": "new"})
    assert unchanged(folder)


def test_a_folder_that_is_gone_is_one_sentence(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="No such file") as caught:
        write_together(tmp_path / "gone", {"a": "new"})
    assert caught.value.exit_code == 1
