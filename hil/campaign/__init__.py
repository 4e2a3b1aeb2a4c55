"""Campaign: plan, run, archive; resumable. Names are imported on first use."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hil.errors import CampaignFolderError

if TYPE_CHECKING:
    from .campaign import Campaign
    from .errors import (
        MotionFailedError,
        MotionRefusedError,
        NotRehearsedError,
    )
    from .folder import CampaignFolder
    from .link import MotionLink, Progress
    from .operator import Stop, stop_on_interrupt
    from .plan import CampaignPlan, PlannedMotion, design, plan_around
    from .virtual_link import VirtualLink

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
_HOME = {
    "Campaign": "campaign",
    "CampaignFolder": "folder",
    **dict.fromkeys(("MotionLink", "Progress"), "link"),
    "VirtualLink": "virtual_link",
    **dict.fromkeys(("Stop", "stop_on_interrupt"), "operator"),
    **dict.fromkeys(("CampaignPlan", "PlannedMotion", "design", "plan_around"), "plan"),
}

if not TYPE_CHECKING:  # which would accept any name

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{_HOME.get(name, 'errors')}"), name)


def __dir__() -> list[str]:
    """Return all names, also those that are not loaded yet."""
    return [*globals(), *__all__]
