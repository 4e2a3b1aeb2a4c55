"""Campaign: plan, run, archive; resumable. Names are imported on first use."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .campaign import Campaign as Campaign
    from .errors import CampaignFolderError as CampaignFolderError
    from .errors import MotionFailedError as MotionFailedError
    from .errors import MotionRefusedError as MotionRefusedError
    from .errors import NotRehearsedError as NotRehearsedError
    from .folder import CampaignFolder as CampaignFolder
    from .link import Link as Link
    from .link import MotionLink as MotionLink
    from .link import Progress as Progress
    from .operator import Stop as Stop
    from .operator import stop_on_interrupt as stop_on_interrupt
    from .plan import CampaignPlan as CampaignPlan
    from .plan import PlannedMotion as PlannedMotion
    from .plan import design as design
    from .plan import plan_around as plan_around

_HOME = {
    "Campaign": "campaign",
    "CampaignFolder": "folder",
    **dict.fromkeys(("Link", "MotionLink", "Progress"), "link"),
    **dict.fromkeys(("Stop", "stop_on_interrupt"), "operator"),
    **dict.fromkeys(("CampaignPlan", "PlannedMotion", "design", "plan_around"), "plan"),
}

if not TYPE_CHECKING:  # which would accept any name

    def __getattr__(name: str) -> Any:
        module = _HOME.get(name, "errors" if name.endswith("Error") else None)
        if module is None:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(import_module(f"{__name__}.{module}"), name)
