"""Campaign: plan, run, archive; resumable. Names are imported on first use."""

from typing import TYPE_CHECKING

from hil.base.errors import CampaignFolderError
from hil.base.first_use import on_first_use

if TYPE_CHECKING:
    from hil.control.errors import MotionFailedError, MotionRefusedError
    from hil.control.link import MotionLink, Progress
    from hil.control.motion_watch import Stop, stop_on_interrupt
    from hil.control.virtual_link import VirtualLink

    from .campaign import Campaign
    from .errors import NotRehearsedError
    from .folder import CampaignFolder
    from .plan import CampaignPlan, PlannedMotion, design, plan_around

__all__ = [
    "Campaign",
    "CampaignFolder",
    "CampaignFolderError",
    "CampaignPlan",
    "VirtualLink",
    "MotionFailedError",
    "MotionLink",
    "MotionRefusedError",
    "NotRehearsedError",
    "PlannedMotion",
    "Progress",
    "Stop",
    "design",
    "plan_around",
    "stop_on_interrupt",
]

if not TYPE_CHECKING:
    __getattr__, __dir__ = on_first_use(
        __name__,
        {
            "hil.campaign.campaign": ("Campaign",),
            "hil.campaign.errors": ("NotRehearsedError",),
            "hil.campaign.folder": ("CampaignFolder",),
            "hil.campaign.plan": ("CampaignPlan", "PlannedMotion", "design", "plan_around"),
            "hil.control.errors": ("MotionFailedError", "MotionRefusedError"),
            "hil.control.link": ("MotionLink", "Progress"),
            "hil.control.motion_watch": ("Stop", "stop_on_interrupt"),
            "hil.control.virtual_link": ("VirtualLink",),
        },
    )
