"""A campaign: all motions of one plan on one cell, each checked, run once and archived once."""

from __future__ import annotations

import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from hil.archive.live import LiveView
from hil.base.errors import CampaignFolderError, HilError, InputError
from hil.base.progress import Reporter, Silent
from hil.cell import Cell
from hil.control.link import MotionLink
from hil.control.motion_watch import Stop, Unattended
from hil.pipeline.options import Options
from hil.precision.requirements import Requirement
from identification.excitation import Excitation

from .campaign_run import RunResult, run_motions
from .folder import LOCK, PAYLOADS, CampaignFolder
from .motion_runner import RunOptions
from .operator import Operator, RunWatch
from .plan import CampaignPlan
from .rehearsal_record import Rehearsal
from .rehearsal_run import SEED, rehearse
from .state import CampaignState
from .status import CampaignStatus, status_of

if TYPE_CHECKING:
    from hil.pipeline.identification import Identification


class Campaign(CampaignState):
    """A campaign: its state, and everything that is done with it."""

    def status(self) -> CampaignStatus:
        """Return which steps are done, and the command for the next one."""
        return status_of(self)

    def rehearse(
        self,
        *,
        reporter: Reporter | None = None,
        seed: int | None = None,
        stop: Stop | None = None,
        again: bool = False,
    ) -> Rehearsal:
        """Run the plan on a simulated copy of the cell, and judge it.

        The result is in `rehearsal.json` and is valid while cell, URDF and plan are unchanged. A
        passed rehearsal is not repeated.

        Args:
            reporter: receives the progress.
            seed: of the simulated parameters, noise and link faults.
            stop: ends it early.
            again: repeat a passed rehearsal.

        Raises:
            MotionRefusedError: a motion breaks a limit of the cell.
            OperatorStopError: it was stopped.
            CampaignFolderError: the folder was changed, or is in use by a run.
        """
        reporter = reporter or Silent()
        stop = stop or Stop()
        seed = SEED if seed is None else seed
        return rehearse(self, reporter, seed=seed, stop=stop, again=again)

    def identify(
        self, options: Options | None = None, *, reporter: Reporter | None = None
    ) -> Identification:
        """Estimate from the archives, judge, and write results, exports and report to the folder.

        Raises:
            InputError: there is no complete excitation yet, or the archives cannot be used.
            OutputError: the folder cannot be written to.
        """
        from hil.campaign.identified_campaign import identify_campaign
        from hil.report.output_files import write_outcome

        reporter = reporter or Silent()
        identification = identify_campaign(self.folder.root, reporter, options or Options())
        return replace(
            identification, results=write_outcome(self.folder.root, identification, reporter)
        )

    def report(self, *, reporter: Reporter | None = None) -> Path:
        """Write the report again from the results, or from the archives if there are newer ones.

        Raises:
            InputError: nothing can be identified yet.
            OutputError: the folder cannot be written to.
        """
        from hil.report.output_files import rewrite_report

        steps = {step.name: step.state for step in self.status().steps}
        if steps["identify"] == "done":
            with suppress(InputError):  # of an older version: identified again
                rewrite_report(self.folder.root)
                return self.folder.report
        self.identify(reporter=reporter)
        return self.folder.report

    def run(
        self,
        link: MotionLink | None = None,
        stop: Stop | None = None,
        reporter: Reporter | None = None,
        *,
        operator: Operator | None = None,
        provenance: Mapping[str, str] | None = None,
        durable: bool | None = None,
        unrehearsed: bool = False,
        dry_run_only: bool = False,
        accept_dry_run: bool = False,
        accept_torque: Sequence[str] = (),
        live: LiveView | None = None,
        until_precise: Sequence[Requirement] = (),
        repetitions: int | None = None,
        say_unchecked: bool = True,
    ) -> RunResult:
        """Run the motions that are missing, in order, and return the arm to its first position.

        The plan must have passed its rehearsal, and runs at full speed only after its dry run was
        accepted. Every motion is checked before the first one is sent. A motion that fails its
        quality check is archived as rejected, with the reason, and run again.

        Args:
            link: to the controller; by default the cell's own. That of a cell with the transport
                "simulated" is a simulated controller in virtual time.
            stop: brings the arm to rest on its path.
            reporter: receives the progress.
            operator: is shown each motion, may slow or hold it, and is asked to accept the dry run.
            provenance: metadata of every archive, e.g. whether it is simulated.
            durable: wait at each flush until the disk has the data; by default in real time only.
            unrehearsed: run without rehearsal and dry run; with a simulated arm only.
            dry_run_only: end after the dry run.
            accept_dry_run: accept the dry run of an earlier run; on a simulated link also that of
                this run.
            accept_torque: joints to accept whose torque had the opposite sign of gravity in the
                dry run of an earlier run (`DryRunRecord.against_gravity`).
            live: where viewers may connect, on the cell's own link.
            until_precise: end the repetitions when these are met, or more of them do not help.
            repetitions: to run the excitation up to this number of complete ones; by default to
                that of the cell.
            say_unchecked: report which shapes are not checked for collisions.

        Raises:
            NotRehearsedError: the plan did not pass its rehearsal.
            DryRunError: the dry run of the plan is not accepted.
            MotionRefusedError: a motion failed its check; nothing was sent.
            MotionFailedError: a motion ended otherwise than planned; it is archived.
            RepetitionsRejectedError: a motion failed its quality check too often.
            ControllerError: the controller was not ready.
            OperatorStopError: the operator stopped instead of accepting the dry run.
            CampaignFolderError: the folder was changed, or is in use by another run.
            InputError: a joint to accept is none of the cell.
            OutputError: a result cannot be written.
        """
        if unknown := [joint for joint in accept_torque if joint not in self.cell.joint_names]:
            remedy = f"the joints are {', '.join(self.cell.joint_names)}"
            raise InputError(None, f"no joint {', '.join(unknown)} to accept", remedy=remedy)
        watch = RunWatch(operator or Unattended(), stop or Stop())
        options = RunOptions(
            provenance=provenance,
            durable=durable,
            unrehearsed=unrehearsed,
            dry_run_only=dry_run_only,
            accept_dry_run=accept_dry_run,
            accept_torque=tuple(accept_torque),
            live=live,
            until_precise=tuple(until_precise),
            repetitions=repetitions,
            say_unchecked=say_unchecked,
        )
        return run_motions(self, link, watch, reporter or Silent(), options)


_FILES = ("manifest.json", "cell.toml", "robot.urdf", "plan.json", "rehearsal.json", LOCK)
"""Files of a campaign without recordings. The manifest is removed first: after a crash the rest is
not a campaign."""


def require_replaceable(root: Path) -> None:
    """Refuse to replace a campaign with recordings (CampaignFolderError)."""
    if CampaignFolder(root).manifest():
        raise CampaignFolderError(
            root, "holds a campaign with recordings", "choose another folder (-o)"
        )
    if any((root / PAYLOADS).glob("*")):
        raise CampaignFolderError(root, "holds payload campaigns", "choose another folder (-o)")


def campaign_of_design(root: Path, cell: Cell, excitation: Excitation | CampaignPlan) -> Campaign:
    """Return the campaign of a designed motion or a plan, in the folder of the design.

    An existing campaign of another motion or cell is replaced.

    Raises:
        CampaignFolderError: the existing campaign has recordings, or the folder has other files.
        CellError: the cell file lacks what a campaign needs.
        MotionRefusedError, NoExcitationError: see `Campaign.create`.
    """
    _ = cell.controller  # its absence is reported before the search for validation motions
    folder = CampaignFolder(root)
    if folder.sealed:
        with suppress(HilError):
            return Campaign.create(root, cell, excitation, exist_ok=True)
        require_replaceable(root)
        with folder.locked():
            for name in _FILES:
                (root / name).unlink(missing_ok=True)
            shutil.rmtree(folder.archives, ignore_errors=True)
            shutil.rmtree(folder.rehearsed, ignore_errors=True)
    return Campaign.create(root, cell, excitation)
