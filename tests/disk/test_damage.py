"""Damaged archives of a completed campaign never change an estimate without a message."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from hil.archive import open_archive
from hil.base.errors import ArchiveError
from hil.base.progress import Silent
from hil.pipeline.identification import identify_archives
from tests.disk.damage import KINDS, SWAPPED, campaign, harmed, play
from tests.disk.readers import Undamaged, blamed
from tests.hil.mcap_bytes import chunks
from tests.laws.table import broken

pytestmark = pytest.mark.safety

HARMED = "archives/excitation_000_a1.mcap"


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> Undamaged:
    return campaign(tmp_path_factory.mktemp("damage"), repetitions=2)


def test_each_kind_of_damage_is_named_or_harmless(truth: Undamaged) -> None:
    for number, kind in enumerate([SWAPPED, *KINDS]):
        damage, laws = play(truth, number, kind)
        assert not laws, f"round {number}, {damage}"


@pytest.mark.parametrize(
    ("text", "blames"),
    [
        (f"/elsewhere/{HARMED}: the chunk at 3 is damaged", True),
        ("{root}: an archive has another checksum", True),
        ("an .mcap file is invalid", False),
        ("{root}/archives/excitation_001_a1.mcap: the chunk at 3 is damaged", False),
    ],
)
def test_error_must_name_what_was_damaged(truth: Undamaged, text: str, blames: bool) -> None:
    assert blamed(text.format(root=truth.root), truth, [truth.root / HARMED]) is blames


@pytest.mark.slow
def test_hundreds_of_damages_are_named_or_harmless(tmp_path: Path) -> None:
    truth = campaign(tmp_path)
    rounds = {number: play(truth, number) for number in range(1000, 1300)}
    assert not {number: outcome for number, outcome in rounds.items() if outcome[1]}


def excitations(truth: Undamaged) -> list[Path]:
    return [path for path in truth.paths if path.name.startswith("excitation")]


@pytest.fixture
def restored(truth: Undamaged) -> Iterator[Undamaged]:
    yield truth
    for path, data in truth.files.items():
        path.write_bytes(data)


def test_repetition_truncated_before_fast_motion_is_named(restored: Undamaged) -> None:
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


def test_wrong_sample_violates_a_law(truth: Undamaged, monkeypatch: pytest.MonkeyPatch) -> None:
    """An archive shows a current that is one step higher."""
    path = excitations(truth)[0]

    def wrong(where: Path, **how: object) -> object:
        archive = open_archive(where, **how)  # type: ignore[arg-type]
        if "target_current" not in archive.columns or where != path:
            return archive
        current = archive.columns["target_current"].copy()
        current[len(current) // 2] += 0.002
        return replace(archive, columns={**archive.columns, "target_current": current})

    monkeypatch.setattr("tests.disk.readers.open_archive", wrong)
    unchanged = {path: truth.files[path]}
    assert any("never written" in text for _, text in broken(harmed(truth, unchanged, 1)))
