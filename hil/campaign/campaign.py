"""A campaign: all motions of one plan on one cell, each checked, run once and archived once."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING

from hil.archive.live import LiveView
from hil.cell import Cell
from hil.design.run import DESIGN_FILES
from hil.errors import HilError, InputError, OutputError
from hil.files import make_folder, write_atomically
from hil.motion_checks import MotionChecks
from hil.progress import Reporter, Silent
from identification.excitation import Excitation

from .errors import CampaignFolderError, WrongObjectError
from .folder import LOCK, CampaignFolder
from .intervals import require_runnable
from .motion_link import MotionLink
from .operator import Operator, Stop, Unattended
from .plan import CampaignPlan, plan_around
from .rehearsal import Rehearsal
from .status import CampaignStatus, status_of

if TYPE_CHECKING:
    from hil.identify import Identification, Options
    from sim_fixtures import SimulatedDrive

    from .run import RunResult


@dataclass(frozen=True, eq=False, repr=False)
class Campaign:
    """One folder: a cell, a plan, and what of it has been done."""

    folder: CampaignFolder
    cell: Cell
    plan: CampaignPlan

    @classmethod
    def create(
        cls,
        folder: Path | str,
        cell: Cell,
        excitation: Excitation | CampaignPlan,
        checks: MotionChecks | None = None,
        *,
        exist_ok: bool = False,
    ) -> Campaign:
        """A new campaign folder with its own copies of cell, URDF and plan.

        Args:
            folder: the folder to make; it may hold the design that the plan comes from.
            cell: the cell.
            excitation: an excitation, around which validation motions are drawn as `[campaign]`
                says; or a whole plan, with validation motions of its own.
            checks: those of the cell, where they are at hand.
            exist_ok: open the campaign that the folder holds already, if its cell and its
                excitation are these.

        Raises:
            CampaignFolderError: the folder holds something already; with `exist_ok`, something
                else than this campaign.
            MotionRefusedError: the plan can never run on the cell; no folder was made.
            NoExcitationError: no validation motion keeps the constraints of the cell.
            WrongObjectError: it was given something that is no cell or no excitation.
            OutputError: the disk refuses; the folder is as it was.
        """
        root, plan = _path(folder), excitation
        if not isinstance(cell, Cell):
            remedy = "give one that was loaded (`hil.Cell.load(path)`)"
            raise WrongObjectError("cell", cell, remedy)
        if not isinstance(plan, Excitation | CampaignPlan):
            remedy = (
                "give an Excitation (`hil.design.load_design(folder, cell)`, "
                "`hil.campaign.design`) or a CampaignPlan"
            )
            raise WrongObjectError("excitation", plan, remedy)
        if exist_ok and CampaignFolder(root).plan.exists():
            return cls.open(root)._if_of(cell, plan)
        if isinstance(plan, Excitation):
            checks = checks or MotionChecks.of(cell)
            plan = plan_around(cell, plan, checks)
        require_runnable(cell, plan, checks)
        make_folder(root)
        if any(path.name not in DESIGN_FILES for path in root.iterdir()):
            raise CampaignFolderError(root, "is not empty", "name a new folder")
        made = CampaignFolder(root)
        own = cell.with_urdf(made.cell, made.urdf.name)
        files = {made.urdf: own.urdf, made.cell: own.text, made.plan: plan.to_text()}
        try:
            make_folder(made.archives)
            for path, text in files.items():
                write_atomically(path, text)
            made.seal()
        except (OSError, CampaignFolderError) as error:
            with suppress(OSError):
                for path in files:
                    path.unlink(missing_ok=True)
                made.archives.rmdir()
            if isinstance(error, CampaignFolderError):  # of the manifest
                raise OutputError(root, error.problem) from error
            raise OutputError(root, f"cannot be written to ({error.strerror})") from error
        return cls(made, own, plan)

    @classmethod
    def open(cls, folder: Path | str) -> Campaign:
        """An existing campaign folder.

        Raises:
            CampaignFolderError: it is not one.
            InputError: its cell or plan cannot be read.
        """
        there = CampaignFolder(_path(folder))
        if not there.plan.exists():
            raise CampaignFolderError(
                there.root, "is not a campaign folder", "name one that has plan.json"
            )
        return cls(there, Cell.load(there.cell), CampaignPlan.load(there.plan))

    def _if_of(self, cell: Cell, wanted: Excitation | CampaignPlan) -> Campaign:
        """This campaign.

        Raises:
            CampaignFolderError: its cell or its excitation is another one.
        """
        own = cell.with_urdf(self.folder.cell, self.folder.urdf.name)
        same = (own.text, own.urdf) == (self.cell.text, self.cell.urdf)
        if isinstance(wanted, CampaignPlan):
            fits = self.plan.to_text() == wanted.to_text()
        else:
            mine = self.plan.excitation.trajectory.to_dict()
            fits = json.dumps(mine) == json.dumps(wanted.trajectory.to_dict())
        if not same or not fits:
            what = "excitation" if same else "cell"
            raise CampaignFolderError(
                self.folder.root, f"holds a campaign with another {what}", "name a new folder"
            )
        return self

    def __repr__(self) -> str:
        return f"Campaign({str(self.folder.root)!r}, cell {self.cell.name!r})"

    def status(self) -> CampaignStatus:
        """What is done, what is next, and what to type for it."""
        return status_of(self)

    def rehearse(
        self,
        *,
        reporter: Reporter | None = None,
        seed: int | None = None,
        stop: Stop | None = None,
        again: bool = False,
        drive: SimulatedDrive | None = None,
    ) -> Rehearsal:
        """Run exactly this plan on a simulated twin of the cell, and judge it.

        The result is in `rehearsal.json` and holds as long as cell, URDF and plan stay what they
        are. A rehearsal that passed is not repeated, one that was stopped goes on.

        Args:
            reporter: receives the progress.
            seed: of what is planted in the twin, its noise and its link's faults.
            stop: ends it early.
            again: rehearse once more even if it passed.
            drive: the simulated arm's gears and motors, where they shall not be those of the cell
                file; the result is then returned only, and opens no gate.

        Raises:
            MotionRefusedError: a motion breaks a limit of the cell.
            OperatorStopError: it was stopped; what was recorded remains.
            CampaignFolderError: the folder was changed, or a run is at work on it.
        """
        from .rehearsal_run import SEED, rehearse  # which runs campaigns

        return rehearse(
            self,
            reporter or Silent(),
            seed=SEED if seed is None else seed,
            stop=stop,
            again=again,
            drive=drive,
        )

    def identify(
        self, options: Options | None = None, *, reporter: Reporter | None = None
    ) -> Identification:
        """Estimate from the archives, judge, and write results, exports and report to the folder.

        Raises:
            InputError: there is no whole excitation yet, or the archives cannot be used.
            OutputError: the folder cannot be written to.
        """
        from hil.identify import Options, identify_campaign  # which knows campaign folders
        from hil.outcome import write_outcome

        reporter = reporter or Silent()
        found = identify_campaign(self.folder.root, reporter, options or Options())
        return replace(found, results=write_outcome(self.folder.root, found, reporter))

    def report(self, *, reporter: Reporter | None = None) -> Path:
        """The report, made anew from the results; from the archives where these know more.

        Raises:
            InputError: nothing can be identified yet.
            OutputError: the folder cannot be written to.
        """
        from hil.outcome import rewrite_report  # which knows identifications

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
        repetitions: int | None = None,
    ) -> RunResult:
        """Run what is still missing, in order, and return to where the arm was.

        A plan is run after it passed its rehearsal on the simulated twin, and at full speed only
        after a person has accepted its slow dry run. Every motion is checked before the first one
        is sent. A motion that fails its quality check is archived as rejected, with the reason,
        and run again.

        Args:
            link: to the controller; the cell's own if left out. A cell with the transport
                "simulated" has a simulated controller in virtual time.
            stop: set from outside to bring the arm to rest on its path.
            reporter: receives the progress.
            operator: sees each motion, may slow or hold it, and is asked to accept the dry run;
                nobody if left out.
            provenance: goes into the metadata of every archive, e.g. whether it is simulated.
            durable: wait at each flush until the disk has the data; left out, in real time only.
            unrehearsed: without rehearsal and dry run; only a simulated arm allows that.
            dry_run_only: end after the dry run.
            accept_dry_run: the caller accepts the dry run that was done before; on a simulated
                link also the one that this run does.
            accept_torque: joints whose torque ran against the model's gravity in the dry run that
                was done before (`DryRun.against_gravity`), accepted by name.
            live: of the cell's own link: lets viewers look at what is recorded.
            repetitions: of the excitation that are enough for now, without validation motions;
                the whole plan if left out.

        Raises:
            NotRehearsedError: the plan did not pass its rehearsal.
            DryRunError: nobody has accepted the dry run of the plan.
            MotionRefusedError: a motion failed its check; nothing was sent.
            MotionFailedError: a motion ended otherwise than planned; it is archived.
            RepetitionsRejectedError: a motion failed its quality check again and again.
            ControllerFault: the controller did not come up.
            OperatorStopError: a stop was asked for instead of an answer to the dry run.
            CampaignFolderError: the folder was changed, or another run is at work on it.
            OutputError: what came of it cannot be written down.
        """
        from .run import Run  # which `hil status` does not need

        return Run(
            self,
            link,
            stop or Stop(),
            reporter or Silent(),
            operator or Unattended(),
            given_provenance=provenance,
            durable=durable,
            unrehearsed=unrehearsed,
            dry_run_only=dry_run_only,
            accept_dry_run=accept_dry_run,
            accept_torque=tuple(accept_torque),
            live=live,
            repetitions=repetitions,
        ).execute()


def _path(folder: object) -> Path:
    """A folder as the caller names it."""
    if not isinstance(folder, str | PathLike):
        raise WrongObjectError("folder", folder, "give the path of a folder")
    return Path(folder)


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

    One that is there already stays if it is of this motion and cell, and is replaced otherwise.

    Raises:
        CampaignFolderError: something was recorded in the campaign that is there, or the folder
            holds files that are no campaign's and no design's.
        CellError: the cell file lacks what a campaign needs.
        MotionRefusedError, NoExcitationError: see `Campaign.create`.
    """
    _ = cell.controller  # named before anything is drawn
    folder = CampaignFolder(root)
    if folder.sealed:
        with suppress(HilError):
            return Campaign.create(root, cell, excitation, exist_ok=True)
        require_replaceable(root)
        with folder.locked():
            for name in _OURS:
                (root / name).unlink(missing_ok=True)
            shutil.rmtree(folder.archives, ignore_errors=True)
            shutil.rmtree(folder.rehearsed, ignore_errors=True)
    return Campaign.create(root, cell, excitation)
