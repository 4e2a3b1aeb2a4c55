"""What can go wrong between a supervisor and its exchange process."""

from __future__ import annotations

from drivers.errors import DriverError


class ExchangeError(DriverError):
    """The exchange process could not be started, does not answer, or is gone."""
