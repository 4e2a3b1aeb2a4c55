"""Arguments that many commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

CampaignArgument = Annotated[
    Path, typer.Argument(help="The campaign's folder (`hil design -o`).", show_default=False)
]
ArchivesArgument = Annotated[
    list[Path],
    typer.Argument(
        help="Archives (*.mcap), or one campaign folder.",
        show_default=False,
        metavar="ARCHIVE...",
    ),
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Only the result.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")]
