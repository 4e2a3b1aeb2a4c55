"""Campaign: plan, run, archive; resumable. Names are imported on first use."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hil.base.errors import CampaignFolderError

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
_MODULE_OF_NAME = {
    "Campaign": "hil.campaign.campaign",
    "CampaignFolder": "hil.campaign.folder",
    **dict.fromkeys(("MotionFailedError", "MotionRefusedError"), "hil.control.errors"),
    **dict.fromkeys(("MotionLink", "Progress"), "hil.control.link"),
    "NotRehearsedError": "hil.campaign.errors",
    "VirtualLink": "hil.control.virtual_link",
    **dict.fromkeys(("Stop", "stop_on_interrupt"), "hil.control.motion_watch"),
    **dict.fromkeys(
        ("CampaignPlan", "PlannedMotion", "design", "plan_around"), "hil.campaign.plan"
    ),
}

if not TYPE_CHECKING:  # which would accept any name

    def __getattr__(name: str) -> Any:
        if name not in _MODULE_OF_NAME:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(_MODULE_OF_NAME[name]), name)


def __dir__() -> list[str]:
    """Return all names, including names that are not loaded yet."""
    return [*globals(), *__all__]
