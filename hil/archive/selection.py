"""What is wanted of an archive."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from hil.archive import schema

_NANOSECONDS = 1_000_000_000
_ALWAYS = 1 << 63  # ns, beyond every stamp


@dataclass(frozen=True)
class Selection:
    """Columns, channels and times wanted.

    Attributes:
        fields: columns, None for all.
        topics: channels, None for those that hold the numbers and the events.
        start: first instant [s] on the archive's own clock, None for its beginning.
        stop: end [s], itself left out; None for the archive's end.
    """

    fields: Collection[str] | None = None
    topics: Collection[str] | None = None
    start: float | None = None
    stop: float | None = None

    def __post_init__(self) -> None:
        alike = {schema.CYCLE, schema.MEASURED, schema.COMMANDED, schema.PACKETS}
        named_alike = alike.intersection(self.topics or ())
        if len(named_alike) > 1:
            names = ", ".join(sorted(named_alike))
            raise ValueError(f"columns of {names} have the same names: open one at a time")

    @property
    def times(self) -> tuple[int, int]:
        """First instant and end [ns]."""
        start = -_ALWAYS if self.start is None else round(self.start * _NANOSECONDS)
        stop = _ALWAYS if self.stop is None else round(self.stop * _NANOSECONDS)
        return start, stop

    @property
    def bounded(self) -> bool:
        """Whether only a range of times is wanted."""
        return self.start is not None or self.stop is not None

    @property
    def partial(self) -> bool:
        """Whether some chunks may not be needed."""
        return self.bounded or self.topics is not None

    def numbers(self, recorded: Collection[str]) -> tuple[str, ...]:
        """The channels that give columns, of an archive that has the channels `recorded`."""
        if self.topics is not None:
            return tuple(topic for topic in self.topics if topic != schema.EVENTS)
        if schema.CYCLE in recorded:
            return (schema.CYCLE,)
        return (schema.MEASURED, schema.MOTOR_CURRENT)

    @property
    def events(self) -> bool:
        """Whether events are wanted."""
        return self.topics is None or schema.EVENTS in self.topics
