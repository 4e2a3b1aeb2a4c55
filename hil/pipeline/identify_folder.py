"""Identification of the archives in a folder: of a campaign, or any other."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

from hil.archive import Archive
from hil.archive.campaign_archives import RecordedCampaign
from hil.base.errors import InputError
from hil.base.progress import Reporter
from hil.base.threads import one_thread
from hil.pipeline.identification import Identification, identify_archives
from hil.pipeline.notes import StatedText
from hil.pipeline.options import Options
from identification.hypotheses.diagnosis import TorqueDiagnosis


@one_thread()
def identify_paths(
    archives: Sequence[Path | Archive],
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path | Archive] = (),
    diagnoses: Mapping[Path, TorqueDiagnosis] = MappingProxyType({}),
) -> Identification:
    """Identify from a campaign folder, a folder of archives, or archives.

    Args:
        archives: the folder alone, or archives.
        reporter: of progress.
        options: of the identification.
        predict: archives that are held out.
        diagnoses: what the torques of archives are, by path, where that was asked.

    Raises:
        InputError: the folder contains neither, or is not the only path.
    """
    folder = next((path for path in archives if isinstance(path, Path) and path.is_dir()), None)
    if folder is None:
        return identify_archives(archives, reporter, options, predict=predict, diagnoses=diagnoses)
    if len(archives) > 1:
        raise InputError(
            folder, "is a folder among files", remedy="give one campaign folder, or files only"
        )
    if RecordedCampaign(folder).sealed:
        return identify_recorded(folder, reporter, options, predict=predict)
    recorded = sorted(folder.glob("*.mcap"))  # of `hil record`
    if not recorded:
        remedy = "give a campaign folder (`hil design -o`), or archives (*.mcap)"
        raise InputError(folder, "contains neither a campaign nor archives", remedy=remedy)
    return identify_archives(recorded, reporter, options, predict=predict)


@one_thread()
def identify_recorded(
    root: Path,
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path | Archive] = (),
) -> Identification:
    """Identify from the complete archives of a campaign folder.

    How it was executed is added by :func:`hil.campaign.identified_campaign.with_execution_log`.

    Args:
        root: of the campaign.
        reporter: of progress.
        options: of the identification.
        predict: archives that are held out in addition.

    Raises:
        InputError: the folder has no complete excitation.
    """
    campaign = RecordedCampaign(root)
    kinds = ("excitation", "validation")
    paths = [path for kind in kinds for path in campaign.completed(kind)]
    if not paths:
        problem = "its manifest.json has no completed excitation with an intact archive"
        remedy = "run the campaign, or give the archives instead of the folder"
        raise InputError(root, problem, remedy=remedy)
    return identify_archives(
        [*paths, *campaign.completed("standstill")],
        reporter,
        options,
        predict=predict,
        name=root.resolve().name,
        warnings=[*map(StatedText, campaign.damaged())],
    )
