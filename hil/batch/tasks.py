"""What workers are asked to do: functions known by name, with small arguments and answers."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from hil.errors import HilError
from hil.identify.options import Options
from hil.identify.settings import Settings
from identification import IdentificationError
from identification.phase_factor import PhaseFactor

from .cache import Where
from .factors import opened, without_sum
from .keeping import bundle_with_cache
from .on_workers import Part
from .settling import Settled, settle
from .types import ArchiveRef, Broken, Bundle


class Done(NamedTuple):
    """What came of a bundle.

    Attributes:
        read: archives that had to be read.
        bundle: itself, where it was not kept; None where it was.
    """

    read: int
    bundle: Bundle | None


def bundle_kept(refs: Sequence[ArchiveRef], settings: Settings, where: Where) -> Part[None, Done]:
    """Reduce a bundle where what is kept can be seen by whoever asks."""
    found = bundle_with_cache(refs, settings, where)
    return Part(None, Done(found.read, None if found.bundle.lasting else found.bundle))


def bundle_sent(
    refs: Sequence[ArchiveRef], settings: Settings, where: Where
) -> Part[PhaseFactor, Done]:
    """Reduce a bundle where whoever asks sees nothing of what is kept; the sum is added up."""
    found = bundle_with_cache(refs, settings, where)
    return Part(found.bundle.phase, Done(found.read, without_sum(found.bundle)))


def campaign_settled(
    refs: Sequence[ArchiveRef], options: Options, arms: Settings | None, where: Where
) -> Part[None, Settled]:
    """Settle a campaign."""
    return Part(None, settle(refs, options, arms, where))


def opened_once(ref: ArchiveRef) -> Part[None, Broken | None]:
    """Open an archive, to see whether that ends this process."""
    try:
        with opened(ref):
            return Part(None, None)
    except (HilError, IdentificationError) as error:
        return Part(None, Broken(ref.location, str(error)))
