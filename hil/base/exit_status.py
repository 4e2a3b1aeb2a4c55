"""Exit statuses of the command line."""

from __future__ import annotations

from enum import IntEnum


class ExitStatus(IntEnum):
    """What a shell script learns from a command.

    One number may have two names: an archive from which records were lost is as little to be relied
    on as a motion that was refused.
    """

    DONE = 0
    FAILED = 1
    """Internal error, or a disk that cannot be written."""
    BAD_INPUT = 2
    """Input that cannot be used, or that has to be decided by an option first."""
    REFUSED = 3
    """A motion that is not safe; nothing was sent."""
    RECORDS_LOST = 3
    """A repaired archive lacks some of its records."""
    CONTROLLER_FAULT = 4
    NEGATIVE_RESULT = 5
    """Done, but the model is not good, the PC not fit, or archives could not be used."""
    STOPPED = 130
    """Stopped by the operator."""
