"""Damaged archives of a finished campaign never give another estimate without a word."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from hil.archive import open_archive
from hil.archive.check import check_archive
from hil.archive.repair import repair
from hil.batch.workers import LocalWorkers
from hil.errors import ArchiveError, InputError
from hil.identify import identify_archives
from hil.progress import Silent
from tests.disk.damage import KINDS, campaign, main, play
from tests.disk.laws import Undamaged, broken
from tests.hil.mcap_bytes import chunks


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Undamaged:
    return campaign(tmp_path_factory.mktemp("damage"), None, repetitions=2)


def test_a_damage_of_each_kind_is_named_or_harmless(truth: Undamaged) -> None:
    for number, kind in enumerate(sorted(KINDS)):
        words, laws = play(truth, number, None, kind)
        assert not laws, f"round {number}, {words}"


@pytest.mark.slow
def test_hundreds_of_damages_are_named_or_harmless(tmp_path: Path) -> None:
    failed = {}
    with LocalWorkers(1) as workers:
        truth = campaign(tmp_path, workers)
        for number in range(1000, 1300):
            words, laws = play(truth, number, workers if number % 10 == 0 else None)
            if laws:
                failed[number] = (words, laws)
    assert not failed


def excitations(truth: Undamaged) -> list[Path]:
    return [path for path in truth.paths if path.name.startswith("excitation")]


@pytest.fixture
def restored(truth: Undamaged) -> Iterator[Undamaged]:
    yield truth
    for path, data in truth.files.items():
        path.write_bytes(data)


@pytest.mark.parametrize("where", [0, 5, -1])
def test_a_whole_chunk_of_another_repetition_is_noticed(restored: Undamaged, where: int) -> None:
    # Its checksum is right and so is the number of its messages, but it is not the one written.
    path, other = excitations(restored)[:2]
    data, strange = restored.files[path], restored.files[other]
    (begin, end), (first, last) = chunks(data)[where], chunks(strange)[where]
    path.write_bytes(data[:begin] + strange[first:last] + data[end:])
    archive = open_archive(path)
    assert not archive.complete
    assert "(chunk) is of another recording" in str(archive.missing)
    assert archive.n_samples == 50 * (where % len(chunks(data))), "whole chunks before it"


def test_the_content_of_another_recording_behind_a_whole_begin_is_noticed(
    restored: Undamaged, tmp_path: Path
) -> None:
    # Every checksum and every count is right, and so is each cycle: they are another motion's.
    path, other = excitations(restored)[:2]
    data, strange = restored.files[path], restored.files[other]
    path.write_bytes(data[: chunks(data)[0][0]] + strange[chunks(strange)[0][0] :])
    archive = open_archive(path)
    assert "another recording" in str(archive.missing)
    assert archive.n_samples == 0, "nobody knows whose they are"
    assert "outcome" in check_archive(path).faults
    with pytest.raises(ArchiveError, match=r"two recordings.*copy"):
        repair(path, tmp_path / "repaired.mcap")


def test_a_repetition_torn_before_the_arm_moved_fast_is_named(restored: Undamaged) -> None:
    path = excitations(restored)[1]
    data = restored.files[path]
    refused = []
    for begin, _ in chunks(data)[1::2]:
        path.write_bytes(data[:begin])
        try:
            identify_archives(restored.paths, Silent())
            break
        except ArchiveError as error:
            refused.append(str(error))
    assert all(path.name in text and "leave it out" in text for text in refused)
    assert any("not one usable sample" in text for text in refused)


def test_a_reader_that_believes_a_wrong_sample_is_found(
    truth: Undamaged, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The laws can be broken: here by an archive that shows a current one step higher."""
    path = excitations(truth)[0]

    def wrong(where: Path, **how: object) -> object:
        archive = open_archive(where, **how)  # type: ignore[arg-type]
        if "target_current" not in archive.columns or where != path:
            return archive
        current = archive.columns["target_current"].copy()
        current[len(current) // 2] += 0.002
        return replace(archive, columns={**archive.columns, "target_current": current})

    monkeypatch.setattr("tests.disk.laws.open_archive", wrong)
    assert any("never written" in law for law in broken(truth, [path], 1))


def test_rounds_in_the_journal_are_not_run_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    journal = tmp_path / "rounds.jsonl"
    journal.write_text('{"round": 3, "harm": "cut in x", "broken": ["a law"]}\n{"rou')
    assert main(["--rounds", "0", "--journal", str(journal), "--json"]) == 1
    assert '"seeds_failed": [3]' in capsys.readouterr().out


HARMED = "archives/excitation_000_a1.mcap"


@pytest.mark.parametrize(
    ("text", "passes"),
    [
        (f"/elsewhere/{HARMED}: the chunk at 3 is torn", True),
        ("{root}: an archive has another checksum", True),
        ("something in A/s is odd", False),
        ("an .mcap file is odd", False),
        ("{root}/archives/excitation_001_a1.mcap: the chunk at 3 is torn", False),
    ],
)
def test_an_error_has_to_blame_what_was_damaged(
    truth: Undamaged, monkeypatch: pytest.MonkeyPatch, text: str, passes: bool
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise ArchiveError(None, text.format(root=truth.root))

    for reader in ("open_archive", "check_archive", "view_of", "identify_archives"):
        monkeypatch.setattr(f"tests.disk.laws.{reader}", refused)
    laws = list(broken(truth, [truth.root / HARMED], 0))
    assert all("names nothing that was damaged" in law for law in laws)
    assert bool(laws) is not passes


def test_an_estimate_of_other_parameters_has_to_be_told_of(
    truth: Undamaged, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = identify_archives(truth.paths, Silent())
    pooled = whole.estimate.pooled
    fewer = replace(pooled, values=pooled.values[1:])
    found = SimpleNamespace(estimate=SimpleNamespace(pooled=fewer), results=whole.results)
    monkeypatch.setattr("tests.disk.laws.identify_archives", lambda *_: found)
    path = excitations(truth)[0]
    (law,) = broken(truth, [path], 0)
    assert law == f"identify: another estimate, and nothing is said of {path.name}"


@pytest.mark.parametrize(
    ("said", "found"),
    [
        (None, "one campaign was compared"),
        ("{root}: is the only campaign given", ""),
        ("{root}: is of another arm", "it says: "),
        ("nothing was given", "it says: "),
    ],
)
def test_a_comparison_of_one_campaign_has_to_say_so(
    truth: Undamaged, monkeypatch: pytest.MonkeyPatch, said: str | None, found: str
) -> None:
    def gathered(*_: object) -> None:
        if said is not None:
            raise InputError(None, said.format(root=truth.root))

    monkeypatch.setattr("tests.disk.laws.gather", gathered)
    monkeypatch.setattr("tests.disk.laws._pools", lambda *_: iter(()))
    move = next(path for path in sorted(truth.files) if path.name.startswith("move"))
    with LocalWorkers(1) as workers:
        laws = list(broken(truth, [move], 0, workers))
    assert [found in law for law in laws] == ([True] if found else [])
