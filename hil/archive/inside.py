"""What a chunk holds, message by message, without decoding any."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hil.archive import index
from hil.archive.container import Damage, Record
from hil.archive.index import MessageHead

_STAMP = struct.Struct("<iI")  # s, ns
_STAMP_AT = 4  # in the data of a message, behind its encapsulation


@dataclass
class Inside:
    """What a chunk holds.

    Attributes:
        data: its records, decompressed.
        offset: where it stands in the file, for errors.
        numbered: sequence numbers of its messages, by channel.
        places: where their data begin, by channel.
        announced: its other records.
        logged: log times of all messages [ns].
    """

    data: bytes
    offset: int
    numbered: dict[int, list[int]] = field(default_factory=dict)
    places: dict[int, list[int]] = field(default_factory=dict)
    announced: list[Record] = field(default_factory=list)
    logged: list[int] = field(default_factory=list)

    @classmethod
    def of(cls, data: bytes, offset: int) -> Inside:
        """Go through a chunk.

        Raises:
            Damage: it does not hold whole records.
        """
        found = cls(data, offset)
        for item in index.messages(data, offset):
            if isinstance(item, MessageHead):
                found.numbered.setdefault(item.channel, []).append(item.sequence)
                found.places.setdefault(item.channel, []).append(item.data)
                found.logged.append(item.log_time)
            else:
                found.announced.append(item)
        return found

    @property
    def times(self) -> tuple[int, int]:
        """First and last log time."""
        return min(self.logged, default=0), max(self.logged, default=0)

    def stamps(self, channel: int) -> NDArray[np.int64]:
        """The stamps in the messages of a channel (k,) [ns].

        Raises:
            Damage: a message is too short for one.
        """
        places = self.places[channel]
        if places[-1] + _STAMP_AT + _STAMP.size > len(self.data):
            raise Damage(self.offset, "(chunk) has messages without a stamp")
        stamps = [_STAMP.unpack_from(self.data, at + _STAMP_AT) for at in places]
        return np.array([s * 10**9 + ns for s, ns in stamps], np.int64)
