"""Identification of a campaign: the estimate from its archives, with its execution log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hil.base.progress import Reporter
from hil.base.threads import one_thread
from hil.pipeline.identification import Identification
from hil.pipeline.identify_folder import identify_recorded
from hil.pipeline.options import Options

from .folder import CampaignFolder
from .status import execution_log_of


@one_thread()
def identify_campaign(
    root: Path, reporter: Reporter, options: Options = Options(), *, predict: Sequence[Path] = ()
) -> Identification:
    """Identify from the complete archives of a campaign folder.

    Args:
        root: of the campaign.
        reporter: of progress.
        options: of the identification.
        predict: archives that are held out in addition.

    Raises:
        InputError: the folder has no complete excitation.
    """
    return with_execution_log(identify_recorded(root, reporter, options, predict=predict), root)


def with_execution_log(identification: Identification, root: Path) -> Identification:
    """Return an identification of a campaign folder with the execution log of the campaign."""
    execution_log = execution_log_of(CampaignFolder(root))
    return replace(
        identification, results=identification.results.model_copy(update={"conduct": execution_log})
    )
