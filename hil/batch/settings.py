"""Settings of campaigns: one decides for its arm, the others take them over with their own noise.

Comparisons in time need one law, and sums the same columns.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from hil.archive import Archive
from hil.errors import HilError
from hil.identify.deciding import MOST_READ, carried_over, decide, with_noise
from hil.identify.options import Options
from hil.identify.settings import Settings
from hil.identify.sources import Source, all_fitted
from hil.progress import Silent
from identification import IdentificationError

from .cache import Where
from .cache_codec import settings_from, settings_header
from .factors import cell_in, source_in
from .keys import decision_digest
from .types import ArchiveRef, Broken


class Settled(NamedTuple):
    """Settings of a campaign.

    Attributes:
        settings: None where there is not one archive to settle them from.
        broken: archives that could not be read for it.
    """

    settings: Settings | None
    broken: tuple[Broken, ...]


def consulted(refs: Sequence[ArchiveRef], arms: Settings | None) -> tuple[ArchiveRef, ...]:
    """The archives of a campaign that its settings depend on.

    Args:
        refs: of the campaign.
        arms: settings of the arm; None where this campaign decides on them.
    """
    ordered = sorted(refs, key=lambda ref: ref.order)
    rest = [ref for ref in ordered if ref.use == "standstill"]
    fitted = [ref for ref in ordered if ref.use == "excitation"]
    return (*rest, *fitted[: 1 if arms is not None and rest else MOST_READ])


def known_settings(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, where: Where
) -> Settings | None:
    """What was settled from these archives (see `consulted`) before; None if nothing."""
    if not refs:
        return None
    found = where.store(refs[0].location).get(decision_digest(options, arms, refs))
    return None if found is None else settings_from(found.header)


def settle(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, where: Where
) -> Settled:
    """Settle a campaign from the archives that `consulted` names, and keep what was settled.

    Raises:
        RecordingError: a recording cannot be prepared.
        IdentificationError: a delay was asked for and there is not one usable row.
    """
    known = known_settings(refs, options, arms, where)
    if known is not None:
        return Settled(known, ())
    broken: list[Broken] = []
    rest: Source | None = None
    fitted: list[tuple[Archive, Source]] = []
    for ref in refs:
        try:
            if ref.use != "standstill":
                fitted.append(source_in(ref))
            elif rest is None:
                rest = source_in(ref, to_fit=False)[1]
        except (HilError, IdentificationError) as error:
            broken.append(Broken(ref.location, str(error)))
    if not fitted:
        return Settled(None, tuple(broken))
    sources, _ = with_noise(
        all_fitted(cell_in(fitted[0][0]), fitted, None if rest is None else rest.recording)
    )
    if arms is None:
        settings = decide(sources, options, Silent()).settings
    else:
        settings = carried_over(arms, sources, options)
    if not broken:
        key = decision_digest(options, arms, refs)
        where.store(refs[0].location).put(key, settings_header(settings))
    return Settled(settings, tuple(broken))
