"""Campaign: plan, run, archive; resumable."""

from .campaign import Campaign, Interval
from .errors import CampaignFolderError, MotionFailedError, MotionRefusedError
from .folder import CampaignFolder
from .link import Link, Stop, stop_on_interrupt
from .plan import CampaignPlan, design

__all__ = [
    "Campaign",
    "CampaignFolder",
    "CampaignFolderError",
    "CampaignPlan",
    "Interval",
    "Link",
    "MotionFailedError",
    "MotionRefusedError",
    "Stop",
    "design",
    "stop_on_interrupt",
]
