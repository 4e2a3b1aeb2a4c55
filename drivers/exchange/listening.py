"""Who is listened to while there is no session yet, or none any more."""

from __future__ import annotations

import math
from typing import Final

from drivers.session import Session
from drivers.states import State
from drivers.transports.base import Transport

FALLEN_SILENT: Final = 1.0
"""s without a packet that gets an answer, after which another sender may begin the session."""


def listens_to_all(session: Session) -> bool:
    """Whether there is no session that a change of port could break.

    Before the init packet there is none, and a lost one goes on with the first packet that gets
    an answer: a stray datagram must not decide who is listened to.
    """
    return session.state is State.SYNC or session.deadline == math.inf


class Listening:
    """Lets the link forget its peer where that one does not lead to a session.

    Before the init packet, whoever gets answers is listened to alone until it sends something
    that gets none, or falls silent: another host cannot take over a start that is going on, and one
    that does not go on cannot keep the controller out.
    """

    def __init__(self, transport: Transport, session: Session) -> None:
        self._transport = transport
        self._session = session
        self._answered_at = -math.inf

    def heard(self, answered: bool) -> None:
        """A packet came and was answered, or was not."""
        if not listens_to_all(self._session):
            return
        if answered:
            self._answered_at = self._transport.now
        else:
            self._transport.forget_peer()

    def heard_nothing(self) -> None:
        """Nothing came for a while."""
        session, transport = self._session, self._transport
        if not listens_to_all(session):
            return
        starting = session.state is State.SYNC
        if not starting or transport.now - self._answered_at >= FALLEN_SILENT:
            transport.forget_peer()
