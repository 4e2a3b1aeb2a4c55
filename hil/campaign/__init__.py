"""Campaign: plan, run, archive; resumable."""

from hil.archive.recorder import Recorded

from .campaign import Campaign
from .errors import (
    CampaignFolderError,
    MotionFailedError,
    MotionRefusedError,
    NotRehearsedError,
)
from .folder import CampaignFolder
from .intervals import Interval, require_runnable
from .link import Link
from .live_link import LiveLink
from .motion_link import MotionLink, Progress
from .operator import Stop, stop_on_interrupt
from .plan import CampaignPlan, PlannedMotion, design, plan_around

__all__ = [
    "Campaign",
    "CampaignFolder",
    "CampaignFolderError",
    "CampaignPlan",
    "Interval",
    "Link",
    "LiveLink",
    "MotionFailedError",
    "MotionLink",
    "MotionRefusedError",
    "NotRehearsedError",
    "PlannedMotion",
    "Progress",
    "Recorded",
    "Stop",
    "design",
    "plan_around",
    "require_runnable",
    "stop_on_interrupt",
]
