"""What makes an archive useless to a batch."""

from __future__ import annotations

from hil.errors import ArchiveError, InputError


class TornError(ArchiveError):
    """An archive that is not whole; a batch uses none in part."""

    def __init__(self, location: str, damage: str) -> None:
        super().__init__(location, damage, remedy=f"hil archive repair {location}")


class ChangedError(ArchiveError):
    """An archive that was written to while the batch ran."""

    def __init__(self, location: str) -> None:
        super().__init__(location, "was changed while it was read", remedy="run the batch again")


class UnavailableError(InputError):
    """An address that cannot be read now, for reasons that are not those of its content."""


class NothingToFitError(InputError):
    """A batch without one archive that can be fitted."""


class CacheError(InputError):
    """A folder for what is kept that cannot be written to."""
