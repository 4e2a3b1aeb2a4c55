"""What can go wrong between a supervisor and its exchange process."""

from __future__ import annotations

from drivers.errors import DriverError, RequestError


class ExchangeError(DriverError):
    """The exchange process could not be started, does not answer, or is gone."""


class WithdrawnError(RequestError):
    """A motion was handed over, and not wanted any more before it could begin."""
