"""Archives between two runs: amended, not entered, not checked."""

from __future__ import annotations

import json
import shutil
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from hil.archive import open_archive
from hil.archive.check import check_archive
from hil.archive.repair import amend_outcome
from hil.base.progress import Silent
from hil.batch.cache import CacheLocation
from hil.batch.archive_discovery import discover
from hil.campaign import (
    Campaign,
    quality,
)
from hil.pipeline.notes import NotJudged
from hil.pipeline.sources import gather_sources
from tests.hil.batch_work import Here
from tests.hil.campaign.runs.rig import Make, Operator, kinds, slowing
from tests.messages import NOT_IN_MANIFEST

pytestmark = pytest.mark.safety


def test_an_amended_archive_keeps_its_content(tmp_path: Path, undisturbed: Campaign) -> None:
    path = tmp_path / "excitation_000_a1.mcap"
    shutil.copy(undisturbed.folder.completed("excitation")[0], path)
    before = open_archive(path)
    amend_outcome(path, "rejected", "something touched it")
    after = open_archive(path)
    assert after.complete
    assert check_archive(path).conforms
    amended = {"outcome": "rejected", "reason": "something touched it"}
    assert after.outcome.entries == before.outcome.entries | amended
    assert after.header.entries == before.header.entries
    assert (after.attachments, after.events) == (before.attachments, before.events)
    for name, column in before.columns.items():
        np.testing.assert_array_equal(after.columns[name], column)


class Killed(BaseException):
    """The process of a run is killed."""


def test_an_archive_that_was_not_checked_is_not_pooled(
    tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    campaign = make(repetitions=2)

    def dies(*_: object) -> None:
        raise Killed

    monkeypatch.setattr(quality, "amend_outcome", dies)
    with suppress(Killed):
        campaign.run(operator=Operator(slowing(range(1, 4), number=2)), unrehearsed=True)
    monkeypatch.undo()
    slowed = campaign.folder.archives / "excitation_001_a1.mcap"
    assert open_archive(slowed, fields=()).outcome.outcome == "completed"
    cache = CacheLocation(str(tmp_path / "cache"))
    discovery = discover([str(campaign.folder.root)], cache, Here(), Silent())
    assert slowed.as_posix() not in {ref.location for ref in discovery.refs}
    (skipped,) = (unused for unused in discovery.skipped if unused.path == slowed.as_posix())
    assert NOT_IN_MANIFEST in skipped.reason
    good = campaign.folder.completed("excitation")
    warnings = gather_sources([*good, slowed], 0.5).warnings
    assert NotJudged(slowed.name) in warnings
    again = campaign.run(unrehearsed=True)
    assert again.repetitions == (2, 2)
    assert [rejection.archive for rejection in again.rejected] == [slowed.name], (
        "judged by the next run"
    )


def test_an_archive_that_was_not_entered_is_adopted(tmp_path: Path, undisturbed: Campaign) -> None:
    root = tmp_path / "campaign"
    shutil.copytree(undisturbed.folder.root, root)
    manifest = root / "manifest.json"
    content = json.loads(manifest.read_text("utf-8"))
    gone = ("excitation_003", "valid")
    content["archives"] = [e for e in content["archives"] if not e["name"].startswith(gone)]
    manifest.write_text(json.dumps(content), "utf-8")
    foreign = root / "archives" / "excitation_002_a2.mcap"
    shutil.copy(root / "archives" / "excitation_001_a1.mcap", foreign)
    truncated = root / "archives" / "validation_000_a1.mcap"
    truncated.write_bytes(truncated.read_bytes()[:-50])

    result = Campaign.open(root).run(unrehearsed=True, durable=False)
    assert result.adopted == ("excitation_003_a1.mcap",)
    assert kinds(result) == ["move", "validation", "move"]
    assert result.complete
