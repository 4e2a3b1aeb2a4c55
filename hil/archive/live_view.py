"""Where a viewer finds what is being recorded, and how much of it it gets."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final, Self

from hil.errors import InputError
from hil.whole_number import LAST_PORT

LOOPBACK: Final = "127.0.0.1"
PORT: Final = 8765
"""That of the Foxglove WebSocket protocol."""
RATE: Final = 50.0
"""Messages of a channel per second: more than a screen shows."""
_ADDRESS: Final = re.compile(r"((?P<host>\[[0-9a-fA-F:.]+\]|[\w.-]+):)?(?P<port>\d{1,5})")


class LiveViewError(InputError):
    """The live view cannot be served as asked for."""


@dataclass(frozen=True)
class LiveView:
    """A live view that was asked for; pickles.

    Attributes:
        host: address it is bound to; anybody who reaches that address may look.
        port: TCP.
        rate: cycles published per second, at most.
    """

    host: str = LOOPBACK
    port: int = PORT
    rate: float = RATE

    @classmethod
    def parse(cls, text: str) -> Self:
        """Read HOST:PORT, or PORT alone for this computer only.

        Raises:
            LiveViewError: it is neither.
        """
        match = _ADDRESS.fullmatch(text.strip())
        if match is None or int(match["port"]) > LAST_PORT:
            remedy = f"e.g. {LOOPBACK}:{PORT}"
            raise LiveViewError(None, f"--live {text} is no HOST:PORT", remedy=remedy)
        return cls((match["host"] or LOOPBACK).strip("[]"), int(match["port"]))

    @property
    def invitation(self) -> str:
        """One line that says where to look."""
        return f"live view: open ws://{self} in Foxglove"

    def __str__(self) -> str:
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{host}:{self.port}"
