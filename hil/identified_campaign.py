"""Identification of a folder: the archives of a campaign, with its conduct, or others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from hil.campaign.folder import CampaignFolder
from hil.errors import InputError
from hil.identify.options import Options
from hil.identify.run import Identification, identify_archives
from hil.progress import Reporter
from hil.reading import path_exists
from hil.threads import one_thread


@one_thread()
def identify_paths(
    paths: Sequence[Path],
    reporter: Reporter,
    options: Options = Options(),
    *,
    predict: Sequence[Path] = (),
) -> Identification:
    """Identify from a campaign folder, a folder of archives, or archives.

    Raises:
        InputError: the folder contains neither, or is not the only path.
    """
    folder = next((path for path in paths if path.is_dir()), None)
    if folder is None:
        return identify_archives(paths, reporter, options, predict=predict)
    if len(paths) > 1:
        raise InputError(
            folder, "is a folder among files", remedy="give one campaign folder, or files only"
        )
    if path_exists(folder / "manifest.json"):
        return identify_campaign(folder, reporter, options, predict=predict)
    archives = sorted(folder.glob("*.mcap"))  # of `hil record`
    if not archives:
        remedy = "give a campaign folder (`hil design -o`), or archives (*.mcap)"
        raise InputError(folder, "contains neither a campaign nor archives", remedy=remedy)
    return identify_archives(archives, reporter, options, predict=predict)


@one_thread()
def identify_campaign(
    root: Path, reporter: Reporter, options: Options = Options(), *, predict: Sequence[Path] = ()
) -> Identification:
    """Identify from the complete archives of a campaign folder; `predict` adds held-out archives.

    Raises:
        InputError: the folder has no complete excitation.
    """
    folder = CampaignFolder(root)
    kinds = ("excitation", "validation")
    paths = [path for kind in kinds for path in folder.completed(kind)]
    if not paths:
        problem = "its manifest.json has no completed excitation with an intact archive"
        remedy = "run the campaign, or give the archives instead of the folder"
        raise InputError(root, problem, remedy=remedy)
    identification = identify_archives(
        [*paths, *folder.completed("standstill")],
        reporter,
        options,
        predict=predict,
        name=root.resolve().name,
        warnings=folder.damaged(),
    )
    from hil.campaign.status import conduct_of  # only a campaign needs what executes it

    conduct = conduct_of(folder)
    return replace(
        identification, results=identification.results.model_copy(update={"conduct": conduct})
    )
