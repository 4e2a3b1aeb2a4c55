"""`hil status`: show the progress of a campaign and the next command."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table
from rich.text import Text

from hil.base.progress import put
from hil.base.terminal_text import printable
from hil.campaign.state import CampaignState
from hil.campaign.status import CampaignStatus, status_of
from hil.cli.arguments import CampaignArgument, JsonOption, print_json

_MARKS = {"done": ("done", "green"), "next": ("next", "bold yellow"), "blocked": ("blocked", "dim")}


def status(
    campaign: CampaignArgument,
    json: JsonOption = False,
) -> None:
    """Show which steps of CAMPAIGN are done, which is next, and its command.

    Changes nothing, and can be used while the campaign runs.
    """
    progress = status_of(CampaignState.open(campaign))
    if json:
        print_json(progress.to_dict())
        return
    console = Console()
    console.print(_table(progress))
    put(console, _last(progress))


def _last(progress: CampaignStatus) -> str:
    """Return the line with the next command."""
    if progress.complete:
        return "all steps are done"
    if progress.only_weighs and not progress.weighing:
        names = ", ".join(progress.weighed)
        arm = next(step.command for step in progress.steps if step.state == "next")
        return f"weighed: {names} (in payload/); nothing is missing. To identify the arm: {arm}"
    if progress.next_command:
        return f"next: {progress.next_command}"
    stuck = next(step for step in progress.steps if step.state == "next")
    return f"next: {stuck.sentence}"


def _table(progress: CampaignStatus) -> Table:
    table = Table(
        title=Text(printable(progress.root)), title_justify="left", box=None, pad_edge=False
    )
    table.add_column("step", no_wrap=True)
    table.add_column("", no_wrap=True)
    table.add_column("detail", overflow="fold")
    for step in progress.steps:
        word, style = _MARKS[step.state]
        table.add_row(step.name, Text(word, style=style), Text(printable(step.sentence)))
    return table
