"""Own files that may have been edited: read as written, or refused by name."""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from functools import lru_cache, partial
from pathlib import Path

from hil.base.errors import CampaignFolderError, InputError
from hil.campaign.dry_run_record import DryRunRecord
from hil.campaign.errors import NotRehearsedError
from hil.campaign.folder import CampaignFolder
from hil.campaign.joint_warm_up import WarmUpRecord
from hil.campaign.plan import CampaignPlan
from hil.campaign.rehearsal_record import Rehearsal
from hil.design.result import DesignResult, _seal
from hil.design.settings import load_settings, preset_text
from hil.results.results import Results
from tests.fuzz.draw import mutate_text
from tests.fuzz.targets import Target, place_of
from tests.hil.fast_cell import fast_campaign, fast_cell

NAMES = (
    "plan.json", "settings.toml", "results.json", "manifest.json", "rehearsal.json", "dry_run.json",
    "warmup.json", "moves.toml", "moves.json", "excitation.toml",
)  # fmt: skip
"""First byte of an input: which file the others are."""
_SEALED = re.compile(r'^sha256 = "[^"]*"', re.MULTILINE)


folder = lru_cache(partial(place_of, "documents"))


def run(data: bytes) -> bool:
    """Read one of them; whether it could be."""
    name = NAMES[data[0] % len(NAMES)] if data else NAMES[0]
    path = folder() / name
    path.write_bytes(data[1:])
    try:
        READERS[name](path)
    except InputError as error:
        explained(error)
        return False
    finally:
        path.unlink()
    return True


def explained(error: InputError) -> None:
    """Check that an error names file and problem."""
    assert error.path is not None, error
    assert error.problem, error


def plan(path: Path) -> None:
    """A plan that is read is written as what it was read from."""
    stored = CampaignPlan.load(path)
    assert stored.is_of(stored.to_text())
    again = path.with_name("again.json")
    again.write_text(stored.to_text())
    assert CampaignPlan.load(again).to_text() == stored.to_text()


def manifest(path: Path) -> None:
    """Everything a run asks of the manifest."""
    folder = CampaignFolder(path.parent)
    for ask in (
        folder.damaged, lambda: folder.completed("excitation"),
        lambda: folder.complete_archive("excitation", 0), lambda: folder.next_name("excitation", 0),
        folder.require_unchanged, lambda: folder.plan_hash,
    ):  # fmt: skip
        try:
            ask()
        except CampaignFolderError as error:
            explained(error)
        except NotRehearsedError as error:
            assert str(path.parent) in str(error), error
    folder.manifest()


def results(path: Path) -> None:
    """A result that is read is written as what it was read from."""
    stored = Results.load(path)
    again = path.with_name("again.json")
    again.write_text(stored.to_json())
    assert Results.load(again).to_json() == stored.to_json()


READERS: dict[str, Callable[[Path], object]] = {
    "plan.json": plan, "settings.toml": load_settings, "results.json": results,
    "manifest.json": manifest,
    "rehearsal.json": lambda path: Rehearsal.load(CampaignFolder(path.parent)),
    "dry_run.json": lambda path: DryRunRecord.load(CampaignFolder(path.parent), "0"),
    "warmup.json": lambda path: WarmUpRecord.load(path, "0"),
    "moves.toml": load_settings, "moves.json": plan,  # inputs of a former reader
    "excitation.toml": DesignResult.load,
}  # fmt: skip


def mutate(data: bytes, most: int, seed: int) -> bytes:
    """A changed text; a design's is sealed again."""
    kind = data[0] % len(NAMES) if data else 0
    changed = mutate_text(data[1:], most - 1, seed)
    if NAMES[kind] == "excitation.toml":
        with suppress(Exception):  # no TOML any more, which is an input as well
            changed = sealed(changed.decode()).encode()
    return bytes((kind,)) + changed


def sealed(text: str) -> str:
    """The text of a design with the seal that it would have had."""
    return _SEALED.sub(f'sha256 = "{_seal(text)}"', text)


def design() -> str:
    """The text of the design in the corpus."""
    kind = bytes((NAMES.index("excitation.toml"),))
    files = sorted((Path(__file__).parents[1] / "corpora" / "documents").glob("seed-*"))
    return next(data[1:].decode() for path in files if (data := path.read_bytes())[:1] == kind)


def seeds() -> list[bytes]:
    """Those that are made in a moment; a result and a design lie in the corpus."""
    place = folder() / "seeds"
    place.mkdir(exist_ok=True)
    campaign = fast_campaign(place / "campaign", fast_cell(place, n_via=2))
    root = campaign.folder.root
    texts = {
        "plan.json": (root / "plan.json").read_text(),
        "manifest.json": '{"inputs": {"cell.toml": "00"}, "archives": [{"name": '
        '"excitation_000_a1.mcap", "outcome": "completed", "sha256": "00", "reason": ""}]}',
        "rehearsal.json": (root / "rehearsal.json").read_text(),
        "dry_run.json": DRY_RUN, "warmup.json": WARMUP,
        "settings.toml": preset_text("gradient"),
    }  # fmt: skip
    return [bytes((NAMES.index(name),)) + text.encode() for name, text in texts.items()]


DRY_RUN = """{"format_version": 2, "plan_hash": "0", "override": 0.2, "duration": 10.0,
"joint_names": ["a"], "archives": ["x.mcap"], "simulated": true, "current_share": [0.1],
"following_error": [0.1], "missed": 0, "late": 0,
"accepted": {"by": "n", "at": "2026-01-01T00:00:00"}}"""
WARMUP = """{"plan_hash": "0", "joint_names": ["a"], "threshold": 0.01, "outcome": "warm",
"motions": [{"archive": "w.mcap", "friction": [1.0]}], "earlier": [], "moved_at": null}"""

TARGET = Target(run, seeds, mutate, most=40_000, replayed=100)
