"""State of a campaign: its folder, cell and plan, and which of its motions are missing."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Self

from hil.base.errors import CampaignFolderError, OutputError
from hil.base.files import make_folder, write_atomically
from hil.base.safe_input import path_exists, remedy_for_missing
from hil.campaign.planned_motions import planned_motions, require_runnable
from hil.cell import Cell
from hil.control.motion_checks import MotionChecks
from hil.control.motions import CampaignMotion
from hil.design.design import DESIGN_FILES
from identification.excitation import Excitation

from .folder import CampaignFolder
from .plan import CampaignPlan, plan_around
from .precision_record import PrecisionRecord


@dataclass(frozen=True, eq=False, repr=False)
class CampaignState:
    """A campaign folder with its cell and its plan."""

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
    ) -> Self:
        """Create a campaign folder with its own copies of cell, URDF and plan.

        Args:
            folder: the folder to create; it may hold the design of the excitation.
            cell: the cell.
            excitation: an excitation, to which random validation motions are added as given in
                `[campaign]`; or a plan with its own validation motions.
            checks: of the cell, if available.
            exist_ok: open the campaign of the folder if it has this cell and excitation.

        Raises:
            CampaignFolderError: the folder is not empty; with `exist_ok`, it is another campaign.
            MotionRefusedError: the plan cannot run on the cell; no folder was created.
            NoExcitationError: no validation motion satisfies the constraints of the cell.
            OutputError: the disk refuses; the folder is unchanged.
        """
        root = Path(folder)
        plan = excitation
        if exist_ok and CampaignFolder(root).plan.exists():
            return cls.open(root)._require_same(cell, plan)
        if isinstance(plan, Excitation):
            checks = checks or MotionChecks.of(cell)
            plan = plan_around(cell, plan, checks)
        require_runnable(cell, plan, checks)
        make_folder(root)
        if any(path.name not in DESIGN_FILES for path in root.iterdir()):
            raise CampaignFolderError(root, "is not empty", "choose a new folder")
        made = CampaignFolder(root)
        own_cell = cell.with_urdf(made.cell, made.urdf.name)
        files = {made.urdf: own_cell.urdf, made.cell: own_cell.text, made.plan: plan.to_text()}
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
        return cls(made, own_cell, plan)

    @classmethod
    def open(cls, folder: Path | str) -> Self:
        """Open an existing campaign folder.

        Raises:
            CampaignFolderError: it is not one.
            InputError: its cell or plan cannot be read.
        """
        there = CampaignFolder(Path(folder))
        if not there.plan.exists():
            raise CampaignFolderError(
                there.root,
                "is not a campaign folder",
                remedy_for_missing(there.root, "give one that has plan.json"),
            )
        return cls(there, Cell.load(there.cell), CampaignPlan.load(there.plan))

    def _require_same(self, cell: Cell, plan: Excitation | CampaignPlan) -> Self:
        """Return this campaign if it has this cell and excitation (CampaignFolderError if not)."""
        own_cell = cell.with_urdf(self.folder.cell, self.folder.urdf.name)
        same = (own_cell.text, own_cell.urdf) == (self.cell.text, self.cell.urdf)
        if isinstance(plan, CampaignPlan):
            fits = self.plan.to_text() == plan.to_text()
        else:
            mine = self.plan.excitation.trajectory.to_dict()
            fits = json.dumps(mine) == json.dumps(plan.trajectory.to_dict())
        if not same or not fits:
            what = "excitation" if same else "cell"
            raise CampaignFolderError(
                self.folder.root, f"holds a campaign with another {what}", "choose a new folder"
            )
        return self

    @cached_property
    def motions(self) -> Sequence[CampaignMotion]:
        """All motions of its plan in order, without the moves between them."""
        return planned_motions(self.cell, self.plan)

    @property
    def precision(self) -> PrecisionRecord | None:
        """Precision of its repetitions, if a run measured it."""
        if not path_exists(self.folder.precision):
            return None
        return PrecisionRecord.load(self.folder.precision, self.folder.plan_hash)

    def missing(self, *kinds: str) -> list[CampaignMotion]:
        """Return what is still to be run at full speed, of these kinds or of all.

        Repetitions that a required precision has ended are not missing.
        """
        precision = self.precision
        ended = ("excitation",) if precision is not None and precision.ended else ()
        return [
            motion
            for motion in self.motions
            if motion.kind in (kinds or (motion.kind,))
            and motion.kind not in ended
            and self.folder.complete_archive(motion.kind, motion.index) is None
        ]

    def progress(self, kind: str) -> tuple[int, int]:
        """Return how many motions of a kind are complete, and how many there are to be."""
        done = len(self.folder.completed(kind))
        precision = self.precision if kind == "excitation" else None
        if precision is not None and precision.ended:
            return done, done
        return done, sum(motion.kind == kind for motion in self.motions)
