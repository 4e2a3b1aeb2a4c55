"""The harness: violated laws are found, distinguished, stored and counted once."""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from drivers import CyclicPacket, Guard, Session
from drivers.transports.can import ends
from drivers.transports.can.codecs import write_reply
from drivers.transports.can.ends import ControllerEnd, PcEnd
from hil.archive import ArchiveHeader, open_archive
from hil.errors import ArchiveError
from tests.fuzz import __main__ as command
from tests.fuzz import libfuzzer, targets
from tests.fuzz.draw import Draw
from tests.fuzz.mutate_mcap import join_file, split_file
from tests.fuzz.test_corpora import inputs

PIECE = libfuzzer.Piece("codec", 10.0, 100, 5, 7, 3, 80)


class TestDraw:
    def test_one_changed_byte_changes_one_decision(self) -> None:
        draw, other = Draw(bytes((7, 1, 9))), Draw(bytes((7, 2, 9)))
        first, second = ([d.below(10), d.choice("abc"), d.between(2, 4)] for d in (draw, other))
        assert first == [7, "b", 2]
        assert [a == b for a, b in zip(first, second, strict=True)] == [True, False, True]

    def test_without_bytes_everything_is_the_first_choice(self) -> None:
        draw = Draw(b"")
        assert draw.choice("abc") == "a"
        assert (draw.below(300), draw.integer(), draw.float32(), draw.left) == (0, 0, 0.0, 0)
        assert not draw.chance(255)


def loses_axes(whole: Callable[..., bytes | None]) -> Callable[..., bytes | None]:
    def emptied(*given: object) -> bytes | None:
        packet = whole(*given)
        return packet and packet[:12] + bytes(len(packet) - 12)

    return emptied


def unnamed_errors(entries: dict[str, str]) -> ArchiveHeader:
    return ArchiveHeader.model_validate({**entries, "entries": entries})


encode = CyclicPacket.encode
IN_THE_CODEC = "AssertionError-tests.fuzz.targets.codec"
IN_THE_JUDGE = "AssertionError-tests.drivers.judge"
PLANTED: dict[str, tuple[str, Any, str, Callable[..., Any], str]] = {
    "a guard that lets everything pass":
        ("session", Guard, "check_set_point", lambda *_: None, IN_THE_JUDGE),
    "an exception in the session":
        ("session", Session, "_cyclic", lambda *_: 1 // 0, "ZeroDivision"),
    "a codec that changes a byte":
        ("codec", CyclicPacket, "encode", lambda self: encode(self)[:-1] + b"\7", IN_THE_CODEC),
    "replies by CAN to another packet":
        ("codec", ends, "write_reply", lambda *a: b"\1\1" + write_reply(*a)[2:], IN_THE_CODEC),
    "a PC that receives nothing by CAN":
        ("codec", PcEnd, "receive", lambda *_: None, IN_THE_CODEC),
    "a controller that receives nothing":
        ("codec", ControllerEnd, "receive", lambda *_: None, IN_THE_CODEC),
    "a controller that sends nothing":
        ("codec", ControllerEnd, "packet", lambda *_: int("none"), "ValueError"),
    "a PC that loses axes":
        ("codec", PcEnd, "_packet", loses_axes(PcEnd._packet), IN_THE_CODEC),
    "a controller that loses axes":
        ("codec", ControllerEnd, "_packet", loses_axes(ControllerEnd._packet), IN_THE_CODEC),
    "a header whose errors are not named":
        ("archive", ArchiveHeader, "of", unnamed_errors, "ValidationError"),
}  # fmt: skip
"""Target, what is replaced by what, and the beginning of the cause that shows it."""


@pytest.mark.parametrize("what", PLANTED)
def test_a_planted_defect_is_found(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By an input of the corpus, or of archives by a change of one."""
    name, owner, attribute, value, wanted = PLANTED[what]
    monkeypatch.setattr(owner, attribute, value)
    target, corpus, causes = targets.load(name), inputs(name), set()
    for seed in range(-len(corpus), 60 if name == "archive" else 0):
        data = corpus[seed % len(corpus)]
        try:
            target.run(data if seed < 0 else target.mutate(data, target.most, seed))
        except Exception as error:
            causes.add(libfuzzer.signature(error))
    assert any(cause.startswith(wanted) for cause in causes), causes


class TestMcap:
    def test_split_and_joined_file_is_unchanged(self) -> None:
        for data in targets.load("archive").seeds():
            records = split_file(data) or []
            assert records
            again = split_file(join_file(records, index=False)) or []
            for one, other in zip(records, again, strict=True):
                same = replace(other, body=one.body) if one.inside is not None else other
                assert one == same

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
        name = libfuzzer.signature(self.raised("x"))
        assert name == libfuzzer.signature(self.raised("y"))
        new = [libfuzzer.record_finding(tmp_path, name, data, "text") for data in (b"1", b"2")]
        assert new == [True, False]
        assert (tmp_path / name / libfuzzer.INPUT).read_bytes() == b"1"


class TestJournal:
    def test_pieces_add_up_without_a_truncated_line(self, tmp_path: Path) -> None:
        path = tmp_path / "j.jsonl"
        libfuzzer.append(path, PIECE)
        with path.open("a") as stream:
            stream.write('{"target": "codec", "sec')  # killed while writing
        libfuzzer.append(path, libfuzzer.Piece("codec", 5.0, 50, 9, 6, 4, 70, "timeout", False))
        assert command.reported(("codec",), path)["targets"]["codec"] == {
            "inputs": 150, "seconds": 15.0, "edges": 9, "features": 7, "not_reproduced": 1,
            "findings": [],
        }  # fmt: skip

    def test_completed_work_is_not_repeated(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        path = tmp_path / "j.jsonl"
        libfuzzer.append(path, replace(PIECE, seconds=61.0))
        arguments = ["codec", "--minutes", "1", "--journal", str(path), "--json"]
        assert command.main(arguments) == 0
        report = json.loads(capsys.readouterr().out)
        assert (report["inputs"], report["seconds"], report["findings"]) == (100, 61.0, 0)
        libfuzzer.record_finding(Path(f"{path}.files/codec/findings"), "a", b"", "")
        assert command.main(arguments[:-1]) == 1
        assert "finding   a" in capsys.readouterr().out

    @pytest.mark.parametrize(("ended", "status"), [("crash", 1), ("killed", 1), ("stopped", 0)])
    def test_early_end_that_no_input_repeats_is_reported(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str], ended: str, status: int
    ) -> None:
        path = tmp_path / "j.jsonl"
        libfuzzer.append(path, replace(PIECE, seconds=61.0))
        libfuzzer.append(path, replace(PIECE, ended=ended))
        assert command.main(["codec", "--journal", str(path), "--json"]) == status
        assert json.loads(capsys.readouterr().out)["not_reproduced"] == status


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris is not installed")
def test_output_of_libfuzzer_is_parsed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "j.jsonl"
    assert command.main(["codec", "--minutes", "0.15", "--journal", str(path), "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["targets"]["codec"]["features"] > 100
    assert report["inputs"] > 50


@pytest.mark.slow
@pytest.mark.skipif(importlib.util.find_spec("atheris") is None, reason="atheris is not installed")
def test_interrupted_run_leaves_no_process(tmp_path: Path) -> None:
    path = tmp_path / "j.jsonl"
    run = subprocess.Popen(
        [sys.executable, "-m", "tests.fuzz", "codec", "--minutes", "3", "--journal", str(path)],
        cwd=Path(__file__).parents[2], env={**os.environ, "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    corpus = Path(f"{path}.files/codec/corpus")
    planted = len(targets.load("codec").seeds())
    until = time.monotonic() + 120.0
    while len([*corpus.glob("*")]) <= planted and time.monotonic() < until:
        time.sleep(0.2)
    run.send_signal(signal.SIGINT)
    output, _ = run.communicate(timeout=60.0)
    assert run.returncode == 0, output
    (piece,) = libfuzzer.pieces(path)
    assert piece.ended == "stopped"
    assert piece.inputs > planted
    before = {one.name for one in corpus.iterdir()}
    time.sleep(2.0)
    assert before == {one.name for one in corpus.iterdir()}, "a process still runs"
