"""Arguments that many commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

CampaignArgument = Annotated[
    Path, typer.Argument(help="The campaign's folder (`hil design -o`).", show_default=False)
]
QuietOption = Annotated[bool, typer.Option("--quiet", "-q", help="Only the last line.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object instead.")]
