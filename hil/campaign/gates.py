"""What must be done before a campaign moves an arm at full speed; each refusal says what to do."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Final

import numpy as np

from drivers.drive_train import TURN
from hil.archive import ArchiveHeader, open_archive
from hil.cell import Cell
from hil.errors import ArchiveError

from .controller_limits import narrower_thresholds
from .dry_run import DryRun, said_of
from .errors import AgainstGravityError, CampaignFolderError, DryRunError, NotRehearsedError
from .folder import CampaignFolder
from .gravity_check import AGAINST
from .motion_link import MotionLink
from .rehearsal import Rehearsal

_ADDRESS: Final = ("transport", "host", "port", "bind", "can", "packets")
"""Keys of `[controller]` that say where it is, and not what is exchanged."""
_MADE_BY: Final = {"yes": "a simulated arm", "no": "a real arm"}
"""By what an archive says of itself."""


def require_rehearsed(folder: CampaignFolder, plan_hash: str | None = None) -> Rehearsal:
    """The rehearsal of a plan; one that was not passed on the simulated twin is refused.

    Args:
        folder: of the campaign.
        plan_hash: of the plan; the folder's as it lies there if left out.

    Raises:
        NotRehearsedError: there was none of exactly this cell, URDF and plan, or it failed.
        CampaignFolderError: what it left cannot be read.
    """
    found = Rehearsal.load(folder)
    rehearse = f"run `hil rehearse {folder.root}`"
    if found is None:
        raise NotRehearsedError(folder.root, "was not rehearsed", rehearse)
    if not found.covers(folder, folder.plan_hash if plan_hash is None else plan_hash):
        what = "was rehearsed with another cell, URDF or plan than it has now"
        raise NotRehearsedError(folder.root, what, f"{rehearse} again")
    if not found.passed:
        failed = "; ".join(found.failures) or "a criterion was not met"
        remedy = f"correct the cell or design another motion, then {rehearse}"
        raise NotRehearsedError(folder.root, f"failed its rehearsal ({failed})", remedy)
    return found


def require_simulated(folder: CampaignFolder, only_simulated: bool) -> None:
    """Refuse to leave out rehearsal and dry run where an arm may move.

    Raises:
        NotRehearsedError: the link may lead to a real controller.
    """
    if not only_simulated:
        raise NotRehearsedError(
            folder.root,
            "was not rehearsed, and its link leads out of this computer",
            "only a simulated controller on this computer (127.0.0.1) is driven without a "
            f"rehearsal: run `hil rehearse {folder.root}`",
        )


def require_one_world(folder: CampaignFolder, only_simulated: bool) -> None:
    """Refuse to mix a simulated arm and a real one in one campaign.

    What a simulated arm did slowly says nothing of the room around a real one, and what either
    did must not be pooled.

    Raises:
        CampaignFolderError: an archive that is there is of the other kind, or does not say of
            which it is.
    """
    for header in _headers(folder):
        made_by = header.simulated
        if made_by != said_of(only_simulated):
            break
    else:
        return
    what = _MADE_BY.get(made_by, "an arm that they do not name (an earlier version wrote them)")
    link = "a simulated one" if only_simulated else "a real one"
    raise CampaignFolderError(
        folder.root,
        f"holds archives of {what}, and its link leads to {link}",
        "begin a new campaign folder (`hil design`), or restore the cell's [controller]",
    )


def _headers(folder: CampaignFolder) -> Iterator[ArchiveHeader]:
    """What the archives that can be read say of themselves; those that cannot are made anew."""
    for entry in folder.manifest():
        with suppress(ArchiveError):
            if (folder.archives / entry.name).is_file():
                yield open_archive(folder.archives / entry.name, fields=()).header


def require_link_of(cell: Cell, link: MotionLink, root: Path) -> None:
    """Refuse a link that was opened for another arm than the campaign's.

    The address may differ, and what is planted in a simulated arm; a link that does not say what
    it was opened for is used as it is.

    Args:
        cell: of the campaign.
        link: the caller's.
        root: of the campaign.

    Raises:
        CampaignFolderError: URDF, limits, drive train or exchange are not the campaign's.
    """
    other = getattr(link, "cell", None)
    if not isinstance(other, Cell) or other is cell:
        return
    ours, theirs = _as_linked(cell), _as_linked(other)
    differ = [name for name in ours if ours[name] != theirs[name]]
    if differ:
        raise CampaignFolderError(
            root,
            f"its link was opened with another cell ({', '.join(differ)} differ)",
            "open the link with the campaign's own cell (`campaign.cell`)",
        )


def _as_linked(cell: Cell) -> dict[str, Any]:
    """What of a cell decides what a link sends, by table of its file."""
    file = cell.file
    exchange = {} if file.controller is None else file.controller.model_dump(exclude={*_ADDRESS})
    return {
        "URDF": cell.urdf,
        "[limits]": file.limits,
        "[bounds]": file.bounds,
        "[drive_train]": file.drive_train,
        "[controller]": exchange,
    }


def require_own_figures(link: MotionLink, root: Path) -> None:
    """Refuse a controller whose figures replace those that everything was checked with.

    Raises:
        NotRehearsedError: names the differences.
    """
    known = link.connection
    if known.adopted and known.differences:
        raise NotRehearsedError(
            root,
            "was rehearsed and checked with the cell file's drive train, and this link uses the "
            f"controller's ({'; '.join(known.differences)})",
            "write the controller's figures into the cell file and rehearse",
        )


def require_rehearsed_thresholds(
    cell: Cell, link: MotionLink, root: Path, found: DryRun | None
) -> None:
    """Refuse a controller that trips at a smaller following error than the rehearsal allowed.

    Args:
        cell: of the campaign.
        link: connected.
        root: of the campaign.
        found: its dry run, for what was needed then; None where there is none.

    Raises:
        NotRehearsedError: names each joint and both thresholds.
    """
    below = narrower_thresholds(cell, link.connection)
    if not below:
        return
    needed = "what the motions need at full speed, no model tells"
    if found is not None:
        turns = np.abs(cell.drive_train.motor_from_joint) @ np.array(found.following_error) / TURN
        seen = ", ".join(
            f"{joint} {turn:.3g}" for joint, turn in zip(cell.joint_names, turns, strict=True)
        )
        needed = f"at {found.override:.0%} of the speed the dry run needed {seen}"
    raise NotRehearsedError(
        root,
        "was planned and rehearsed with wider following-error thresholds than the controller "
        f"announces ({'; '.join(below)}; {needed})",
        "write the controller's into [drive_train] following_error of the cell file and rehearse, "
        "or widen them in the controller",
    )


def require_dry_run(
    folder: CampaignFolder,
    found: DryRun | None,
    *,
    can_answer: bool,
    accept: bool,
    only_simulated: bool,
) -> None:
    """Refuse before anything moves, where nobody could accept the dry run that is to come.

    Args:
        folder: of the campaign.
        found: the dry run that counts (`DryRun.that_counts`), None for none.
        can_answer: whether there is a person to ask.
        accept: whether the caller accepts beforehand.
        only_simulated: whether nothing but a simulated arm can move.

    Raises:
        DryRunError: it was not done, or is not accepted.
    """
    if found is None and accept and not only_simulated:
        raise DryRunError(
            folder.root,
            "cannot be accepted before it was done",
            f"run `hil run {folder.root} --dry-run`, watch the arm, and accept it then",
        )
    if can_answer or accept or (found is not None and found.accepted is not None):
        return
    if found is None:
        how = f"run `hil run {folder.root} --dry-run` and watch the arm"
        raise DryRunError(folder.root, "was not done, and nobody is here to accept it", how)
    raise not_accepted(folder, found.against_gravity)


def not_accepted(folder: CampaignFolder, against: Sequence[str] = ()) -> DryRunError:
    """What is raised where a dry run that was done is not accepted.

    Args:
        folder: of the campaign.
        against: joints whose torque runs against the model's gravity, and that nobody named.
    """
    if against:
        return AgainstGravityError(folder.root, against, AGAINST)
    how = f"if the motions looked right, run `hil run {folder.root} --accept-dry-run`"
    return DryRunError(folder.root, "was done, but is not accepted", how)
