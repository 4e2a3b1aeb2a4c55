"""Archives behind an address: found, fetched, and refused in one sentence where that fails."""

from __future__ import annotations

import http.server
import re
import threading
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import ClassVar

import fsspec
import pytest

from hil.batch import remote
from hil.batch.remote import archives_below, is_url, local_file
from hil.batch.types import UnavailableError
from hil.errors import InputError
from hil.version import install_command
from tests.hil.web_folder import served

CONTENT = {"a/first.mcap": b"one" * 1_000_000, "b/c/second.mcap": b"", "b/notes.txt": b"no archive"}
ARCHIVES = ["a/first.mcap", "b/c/second.mcap"]


@pytest.fixture(autouse=True)
def _patient_for_no_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "_PAUSES", (0.0, 0.0))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("store")
    for name, content in CONTENT.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_bytes(content)
    return root


@pytest.fixture(scope="module")
def web(folder: Path) -> Iterator[str]:
    with served(folder) as address:
        yield address


@pytest.fixture(scope="module")
def memory() -> str:
    store = fsspec.filesystem("memory")
    for name, content in CONTENT.items():
        store.pipe(f"/store/{name}", content)
    return "memory://store"


@pytest.fixture(params=["web", "memory", "file"])
def root(request: pytest.FixtureRequest, folder: Path) -> str:
    """The same files in three kinds of store."""
    if request.param == "file":
        return folder.as_uri()
    return str(request.getfixturevalue(request.param))


def test_every_archive_below_an_address_is_found_in_order(root: str) -> None:
    found = [url for url, _ in archives_below(root)]
    assert len(found) == len(ARCHIVES)
    for url, name in zip(found, ARCHIVES, strict=True):
        assert is_url(url)
        assert url.endswith(f"/{name}")


def test_an_archive_is_found_by_its_own_address(root: str) -> None:
    ((url, _),) = archives_below(f"{root}/{ARCHIVES[0]}")
    assert url.endswith(ARCHIVES[0])


def test_what_is_found_is_fetched_to_the_byte_and_removed(root: str) -> None:
    for (url, _), name in zip(archives_below(root), ARCHIVES, strict=True):
        with local_file(url) as path:
            assert path.name == Path(name).name
            assert path.read_bytes() == CONTENT[name]
        assert not path.parent.exists()


def test_a_version_is_that_of_the_content_or_none(
    memory: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = f"{memory}/{ARCHIVES[0]}"
    assert archives_below(address)[0][1] == ""
    store = fsspec.get_filesystem_class("memory")
    plain = store.info
    monkeypatch.setattr(store, "info", lambda *path: plain(*path) | {"ETag": '"5f3"'})
    assert archives_below(address)[0][1] == '"5f3"'


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("memory://store/absent.mcap", "is not there"),
        ("http://127.0.0.1:9/x.mcap", "(Cannot connect|its server does not answer)"),
        ("nosuch://store/x.mcap", "Protocol not known: nosuch"),
    ],
)
def test_what_cannot_be_read_is_one_sentence_with_the_address(address: str, message: str) -> None:
    with pytest.raises(InputError, match=f"{address}.*{message}"):
        archives_below(address)
    with pytest.raises(InputError, match=f"{address}.*{message}"), local_file(address):
        pass


class _Busy(http.server.SimpleHTTPRequestHandler):
    """Refuses the first so many requests for a file."""

    refusals: ClassVar[list[int]] = []
    asked: ClassVar[list[str]] = []

    def do_GET(self) -> None:
        self.asked.append(self.path)
        if self.refusals:
            self.send_error(self.refusals.pop())
        else:
            super().do_GET()

    def log_message(self, *_: object) -> None:
        pass


@pytest.fixture
def busy(folder: Path) -> Iterator[str]:
    _Busy.asked.clear()
    handler = partial(_Busy, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()
        thread.join()


def test_a_server_that_is_busy_is_asked_again(busy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Busy, "refusals", [503, 429])
    with local_file(f"{busy}/{ARCHIVES[0]}") as path:
        assert path.read_bytes() == CONTENT[ARCHIVES[0]]
    assert len(_Busy.asked) == 3


def test_a_server_that_stays_busy_is_given_up(busy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(_Busy, "refusals", [503] * 10)
    with pytest.raises(UnavailableError, match="503"), local_file(f"{busy}/{ARCHIVES[0]}"):
        pass
    assert len(_Busy.asked) == 3


def test_what_a_server_does_not_give_is_asked_for_once(
    busy: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(_Busy, "refusals", [403])
    with pytest.raises(UnavailableError, match="403"), local_file(f"{busy}/{ARCHIVES[0]}"):
        pass
    with pytest.raises(UnavailableError, match="not there"), local_file(f"{busy}/absent.mcap"):
        pass
    assert len(_Busy.asked) == 2


def test_without_fsspec_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=re.escape(install_command("cluster"))):
        archives_below("memory://store")


def test_a_path_is_no_address() -> None:
    assert is_url("s3://bucket/campaign")
    assert not is_url("/data/campaign")
    assert not is_url("C:/data")
