"""The motions of a plan in order, and whether they can run."""

from __future__ import annotations

from hil.cell import Cell
from hil.control.motion_checks import MotionChecks
from hil.control.motions import CampaignMotion, CheckedMoves, require_allowed, rest

from .plan import CampaignPlan


def planned_motions(cell: Cell, plan: CampaignPlan) -> list[CampaignMotion]:
    """Return all motions of a plan, without the moves between them."""
    repetitions = cell.campaign.repetitions
    excitation = plan.excitation.trajectory
    return [
        CampaignMotion("standstill", 0, rest(cell.home, cell.campaign.standstill_s)),
        *(CampaignMotion("excitation", k, excitation, plan.moves) for k in range(repetitions)),
        *(
            CampaignMotion("validation", k, m.trajectory, m.moves)
            for k, m in enumerate(plan.validation)
        ),
    ]


def require_runnable(cell: Cell, plan: CampaignPlan, checks: MotionChecks | None = None) -> None:
    """Check that a plan can run on a cell, from any position of its arm (MotionRefusedError)."""
    checks = checks or MotionChecks.of(cell)
    motions = planned_motions(cell, plan)
    require_allowed(motions, checks)  # before moves to them are planned
    CheckedMoves(cell, checks).with_moves(motions, cell.home)
