"""The campaign that a design becomes, beside the design's own files."""

from __future__ import annotations

import shutil
from pathlib import Path

from hil.cell import Cell
from hil.errors import HilError
from identification.excitation import Excitation

from .campaign import Campaign
from .errors import CampaignFolderError
from .folder import CampaignFolder
from .folder_lock import LOCK

_OURS = ("manifest.json", "cell.toml", "robot.urdf", "plan.json", "rehearsal.json", LOCK)
"""What a campaign has before anything is recorded; the manifest goes first, so that what a crash
leaves of the others is no campaign."""


def require_replaceable(root: Path) -> None:
    """Refuse to replace a campaign that something was recorded in.

    Raises:
        CampaignFolderError: there is one in the folder.
    """
    if CampaignFolder(root).manifest():
        raise CampaignFolderError(
            root, "holds a campaign with recordings", "name another folder (-o)"
        )


def campaign_of_design(root: Path, cell: Cell, excitation: Excitation) -> Campaign:
    """A campaign of a designed motion, made in the folder of the design.

    One that is there already is kept if it is of this motion and cell, and replaced otherwise.

    Raises:
        CampaignFolderError: something was recorded in the campaign that is there, or the folder
            holds files that are no campaign's and no design's.
        CellError: the cell file lacks what a campaign needs.
        MotionRefusedError, NoExcitationError: see `Campaign.create`.
    """
    _ = cell.controller  # named before anything is drawn
    folder = CampaignFolder(root)
    if folder.sealed:
        there = _there(root)
        if there is not None and _same(there, cell, excitation):
            return there
        require_replaceable(root)
        with folder.locked():
            for name in _OURS:
                (root / name).unlink(missing_ok=True)
            shutil.rmtree(folder.archives, ignore_errors=True)
            shutil.rmtree(folder.rehearsed, ignore_errors=True)
    return Campaign.create(root, cell, excitation)


def _there(root: Path) -> Campaign | None:
    try:
        return Campaign.open(root)
    except HilError:
        return None


def _same(there: Campaign, cell: Cell, excitation: Excitation) -> bool:
    own = cell.with_urdf(there.folder.cell, there.folder.urdf.name)
    mine, theirs = (one.trajectory.to_dict() for one in (excitation, there.plan.excitation))
    return (there.cell.text, there.cell.urdf, theirs) == (own.text, own.urdf, mine)
