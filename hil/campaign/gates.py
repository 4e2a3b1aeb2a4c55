"""Conditions for running a campaign at full speed; each refusal names its remedy."""

from __future__ import annotations

from contextlib import suppress
from typing import Any, Final

from hil.archive import open_archive
from hil.base.errors import ArchiveError, CampaignFolderError
from hil.base.terminal_text import typed
from hil.cell import Cell
from hil.control.connection import Connection, lower_limits
from hil.control.link import MotionLink
from hil.control.messages import lower_limit_words

from .dry_run_record import DryRunRecord, yes_or_no
from .errors import DryRunError, NotRehearsedError
from .folder import CampaignFolder
from .motion_runner import RunOptions
from .record_messages import not_accepted
from .rehearsal_record import Rehearsal
from .state import CampaignState

_ADDRESS: Final = {"transport", "host", "port", "bind", "can"}
"""Keys of `[controller]` with its address, which do not affect what is exchanged."""


def require_gates(
    campaign: CampaignState,
    link: MotionLink | None,
    plan_hash: str,
    *,
    simulated: bool,
    unrehearsed: bool,
) -> None:
    """Require the arm and the link of this campaign and a passed rehearsal, before anything moves.

    Args:
        campaign: state of its folder.
        link: to the controller.
        plan_hash: of the plan.
        simulated: whether the arm is.
        unrehearsed: whether no rehearsal is required.

    Raises:
        NotRehearsedError: with the remedy.
        CampaignFolderError: folder, archives or link belong to another campaign.
    """
    _require_one_kind_of_arm(campaign.folder, simulated)
    _require_own_link(campaign, link)
    if not unrehearsed:
        require_rehearsed(campaign.folder, plan_hash)
    elif not simulated:
        root = campaign.folder.root
        raise NotRehearsedError(
            root,
            "was not rehearsed, and its link leaves this computer",
            "only a simulated controller on this computer (127.0.0.1) is driven without a "
            f"rehearsal: run `hil rehearse {typed(root)}`",
        )


def require_dry_run(
    folder: CampaignFolder,
    dry_run: DryRunRecord | None,
    options: RunOptions,
    *,
    simulated: bool,
    can_answer: bool,
) -> None:
    """Require a dry run that is accepted or can be, before anything moves.

    Args:
        folder: of the campaign.
        dry_run: that was done, if any.
        options: of the run.
        simulated: whether the arm is.
        can_answer: whether an operator can accept it.

    Raises:
        DryRunError: with the remedy.
    """
    root = folder.root
    first = f"run `{folder.run_command} --dry-run`"
    if dry_run is None and options.accept_dry_run and not simulated:
        remedy = f"{first}, watch the arm, and accept it then"
        raise DryRunError(root, "cannot be accepted before it is done", remedy)
    if can_answer or options.dry_run_only or options.accept_dry_run:
        return
    if dry_run is None:
        remedy = f"{first} and watch the arm"
        if simulated:
            remedy = f"the arm is simulated: accept it with `{folder.run_command} --accept-dry-run`"
        raise DryRunError(root, "was not done, and there is no operator to accept it", remedy)
    if dry_run.accepted is None:
        raise not_accepted(folder, dry_run, dry_run.against_gravity)


def require_rehearsed(folder: CampaignFolder, plan_hash: str | None = None) -> Rehearsal:
    """Return the passed rehearsal of a plan, by default the folder's.

    Raises:
        NotRehearsedError: there was none of this cell, URDF and plan, or it failed.
        CampaignFolderError: its file cannot be read.
    """
    rehearsal = Rehearsal.load(folder)
    rehearse = f"run `hil rehearse {typed(folder.root)}`"
    if rehearsal is None:
        raise NotRehearsedError(folder.root, "was not rehearsed", rehearse)
    if rehearsal.plan_hash != (plan_hash or folder.plan_hash):
        what = "was rehearsed with another cell, URDF or plan than it has now"
        raise NotRehearsedError(folder.root, what, f"{rehearse} again")
    if not rehearsal.passed:
        failed = "; ".join(rehearsal.failures) or "a criterion was not met"
        remedy = f"correct the cell or design another motion, then {rehearse}"
        raise NotRehearsedError(folder.root, f"failed its rehearsal ({failed})", remedy)
    return rehearsal


def _require_one_kind_of_arm(folder: CampaignFolder, simulated: bool) -> None:
    """Refuse to mix a simulated and a real arm; unreadable archives are recorded again.

    A dry run of a simulated arm does not cover the surroundings of a real one, and their archives
    must not be pooled.
    """
    arm_kind = yes_or_no(simulated)
    for entry in folder.manifest():
        path = folder.archives / entry.name
        made_by = arm_kind
        with suppress(ArchiveError):
            if path.is_file():
                made_by = open_archive(path, fields=()).header.simulated or ""
        if made_by != arm_kind:
            kinds = {"yes": "a simulated arm", "no": "a real arm"}
            whose = kinds.get(made_by, "an unknown kind of arm")
            link = "a simulated one" if simulated else "a real one"
            raise CampaignFolderError(
                folder.root,
                f"holds archives of {whose}, and its link leads to {link}",
                "begin a new campaign folder (`hil design`)",
            )


def _require_own_link(campaign: CampaignState, link: MotionLink | None) -> None:
    """Refuse a link opened for another arm; the address and the simulated arm may differ."""
    other = getattr(link, "cell", None)
    if not isinstance(other, Cell) or other is campaign.cell:
        return
    expected = _sent_by(campaign.cell)
    present = _sent_by(other)
    if differ := [name for name in expected if expected[name] != present[name]]:
        raise CampaignFolderError(
            campaign.folder.root,
            f"its link was opened with another cell ({', '.join(differ)} differ)",
            "open the link with the campaign's own cell (`campaign.cell`)",
        )


def _sent_by(cell: Cell) -> dict[str, Any]:
    """Return what affects the packets of a link, by table of the cell file."""
    file = cell.file
    return {
        "URDF": cell.urdf,
        "[limits]": file.limits,
        "[bounds]": file.bounds,
        "[drive_train]": file.drive_train,
        "[controller]": file.controller and file.controller.model_dump(exclude=_ADDRESS),
    }


def require_as_rehearsed(campaign: CampaignState, connection: Connection) -> None:
    """Refuse a controller whose figures differ from rehearsal and checks.

    Raises:
        NotRehearsedError: names joints with a narrower following-error threshold in the
            controller, and both thresholds.
    """
    below = lower_limits(campaign.cell, connection, "following_error")
    if not below:
        return
    raise NotRehearsedError(
        campaign.folder.root,
        "was planned and rehearsed with wider following-error thresholds than the "
        f"controller announces ({'; '.join(map(lower_limit_words, below))})",
        "write the controller's into [drive_train] following_error of the cell file and rehearse, "
        "or widen them in the controller",
    )
