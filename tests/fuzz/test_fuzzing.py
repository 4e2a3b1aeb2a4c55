"""The harness: violated laws are found, distinguished, stored and counted once."""

from __future__ import annotations

import importlib.util
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers import CyclicPacket, Guard, Session
from drivers.transports.can import frames
from drivers.transports.can.frames import CanEndpoint, TransferAssembler, payloads
from hil.archive import ArchiveHeader, open_archive
from hil.base.errors import ArchiveError
from tests.fuzz import __main__ as command
from tests.fuzz import targets
from tests.fuzz.corpora import inputs

pytestmark = pytest.mark.long


def loses_axes(whole: Callable[..., bytes | None]) -> Callable[..., bytes | None]:
    def emptied(*given: object) -> bytes | None:
        packet = whole(*given)
        return packet and packet[:12] + bytes(len(packet) - 12)

    return emptied


def cut_short(packet: bytes, transfer: int) -> list[bytes]:
    return payloads(packet, transfer)[:-1]


encode = CyclicPacket.encode
IN_THE_CODEC = "AssertionError-tests.fuzz.targets.codec"
BY_THE_JUDGE = "AssertionError-tests.drivers.set_points"
PLANTED: dict[str, tuple[str, Any, str, Callable[..., Any], str]] = {
    "a guard that lets everything pass":
        ("session", Guard, "check_set_point", lambda *_: None, BY_THE_JUDGE),
    "an exception in the session":
        ("session", Session, "_cyclic", lambda *_: 1 // 0, "ZeroDivision"),
    "a codec that changes a byte":
        ("codec", CyclicPacket, "encode", lambda self: encode(self)[:-1] + b"\7", IN_THE_CODEC),
    "a link that receives nothing by CAN":
        ("codec", CanEndpoint, "receive", lambda *_: None, IN_THE_CODEC),
    "a link that sends nothing by CAN":
        ("codec", CanEndpoint, "frames", lambda *_: int("none"), "ValueError"),
    "transfers without their last frame":
        ("codec", frames, "payloads", cut_short, IN_THE_CODEC),
    "an assembler that loses axes":
        ("codec", TransferAssembler, "add", loses_axes(TransferAssembler.add), IN_THE_CODEC),
    "a header whose errors are not named":
        ("archive", ArchiveHeader, "of",
         lambda text: ArchiveHeader.model_validate({**text, "entries": text}), "ValidationError"),
}  # fmt: skip
"""Target, what is replaced by what, and the beginning of the cause that shows it."""


@pytest.mark.parametrize("what", PLANTED)
def test_a_planted_defect_is_found(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By an input of the corpus, or of archives by a change of one."""
    name, owner, attribute, value, wanted = PLANTED[what]
    monkeypatch.setattr(owner, attribute, value)
    target = targets.load(name)
    corpus = inputs(name)
    causes = set()
    for seed in range(-len(corpus), 60 if name == "archive" else 0):
        data = corpus[seed % len(corpus)]
        try:
            target.run(data if seed < 0 else target.mutate(data, target.most, seed))
        except Exception as error:
            causes.add(command.signature(error))
    assert any(cause.startswith(wanted) for cause in causes), causes


class TestMcap:
    def test_changes_get_past_the_checksums(self, tmp_path: Path) -> None:
        target = targets.load("archive")
        data = target.seeds()[0]
        read = 0
        for seed in range(60):
            (tmp_path / "a.mcap").write_bytes(target.mutate(data, target.most, seed))
            try:
                read += open_archive(tmp_path / "a.mcap").complete
            except ArchiveError:
                continue
        assert read > 15


class TestFindings:
    def raised(self, wrong: str) -> Exception:
        try:
            np.array([wrong], dtype=float)
            raise AssertionError
        except ValueError as error:
            return error

    def test_one_cause_has_one_folder(self, tmp_path: Path) -> None:
        for wrong in ("x", "y"):
            command.record_finding(tmp_path, self.raised(wrong), wrong.encode())
        (folder,) = tmp_path.iterdir()
        assert (folder / command.INPUT).read_bytes() == b"x"
        assert "could not convert" in (folder / command.TRACEBACK).read_text()


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris is not installed")
def test_fuzzing_extends_the_corpus(tmp_path: Path) -> None:
    arguments = ("-m", "tests.fuzz", "codec", "--minutes", "0.15", "--folder", str(tmp_path))
    done = subprocess.run([sys.executable, *arguments], cwd=command.ROOT, check=False)
    assert done.returncode == 0
    assert len([*(tmp_path / "corpus").iterdir()]) > len(targets.load("codec").seeds())
    assert not [*(tmp_path / "findings").iterdir()]
